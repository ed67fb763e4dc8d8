"""Compiled loops, least squares, medians and threads that centroids, poses and tracking share."""
