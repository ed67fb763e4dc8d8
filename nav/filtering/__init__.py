"""Poses of single pairs to motion: a filter as they come, a smoother for a sequence that is over."""
