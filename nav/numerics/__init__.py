"""Compiled loops and the least-squares solver that centroids and poses share."""
