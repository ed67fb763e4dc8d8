"""Real stereo images of anybody's camera as a dataset without truth."""
