"""Tiers C and D and speed: drawn poses, exact centres and noise, without images."""
