"""Commands that show datasets and models."""
