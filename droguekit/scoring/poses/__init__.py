"""Errors of poses in single pairs, compared with bounds and covariances."""
