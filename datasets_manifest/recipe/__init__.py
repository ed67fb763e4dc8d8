"""Recipes, which describe datasets to make: the sections of their TOML, with validation."""
