"""Training of the detector network on datasets with ground truth."""
