"""Scores that are only defined over sequences: motion, docking, latency, tracking."""
