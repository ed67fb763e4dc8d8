"""Measures the centres of markers and hub in images to a fraction of a pixel."""
