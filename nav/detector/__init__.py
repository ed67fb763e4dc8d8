"""Detectors: the bounding box of the drogue in each image."""
