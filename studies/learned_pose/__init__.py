"""Learned keypoints beside the project's own poses, on the same frames."""
