"""What spreading frames over workers gains and costs."""
