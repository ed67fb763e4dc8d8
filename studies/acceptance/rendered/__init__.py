"""Tiers A, B, E and docking: criteria on rendered pairs and flights."""
