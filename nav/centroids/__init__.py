"""Where in an image the markers are, to a fraction of a pixel."""
