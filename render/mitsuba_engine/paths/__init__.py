"""Rays and paths of one frame, and the light that they bring."""
