"""Commands that find the drogue and score what was found."""
