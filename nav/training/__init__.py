"""Training the detector on datasets with truth."""
