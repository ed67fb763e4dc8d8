"""Whole datasets in other containers."""
