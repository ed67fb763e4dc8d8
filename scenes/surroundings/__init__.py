"""Sampling what is around a drogue: the receiver, obstacles, distractors."""
