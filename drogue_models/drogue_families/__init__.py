"""Meshes, paints and presets of drogues that have a body instead of the flat face."""
