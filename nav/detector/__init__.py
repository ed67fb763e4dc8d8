"""Where in an image the drogue is."""
