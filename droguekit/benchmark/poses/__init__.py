"""Errors of poses in single pairs, beside bounds and covariances."""
