"""Tiers C, D and speed: poses drawn at random, exact feature centres and noise, without images."""
