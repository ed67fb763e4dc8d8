"""Tiers A, B, E and docking: bars on rendered pairs and flights."""
