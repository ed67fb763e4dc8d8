"""Labels and datasets checked from the outside."""
