"""Boxes, masks and keypoints for detectors and annotation tools."""
