"""Which region of which image is which marker."""
