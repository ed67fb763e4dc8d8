"""Rays and paths of one frame: passes of pixel centres, and the light of drogue and context."""
