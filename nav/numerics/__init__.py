"""Compiled loops and least squares that centroids and poses share."""
