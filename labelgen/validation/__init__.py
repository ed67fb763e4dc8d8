"""Checks of labels and datasets."""
