"""Recipes, the data types that packages share, and datasets on disk. No drawing, no rendering."""
