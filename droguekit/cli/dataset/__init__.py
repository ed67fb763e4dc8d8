"""Commands that make, check and convert datasets."""
