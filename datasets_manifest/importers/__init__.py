"""Import of real stereo images as a dataset without truth."""
