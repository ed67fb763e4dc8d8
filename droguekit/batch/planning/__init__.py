"""What a recipe will make, and what it will cost."""
