"""Detectors scored against the truth."""
