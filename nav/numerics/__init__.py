"""Compiled loops, least squares, small matrices, medians and threads that centroids, poses and tracking share."""
