"""The version of the pixels: it changes whenever the same recipe and frame give other pixels than before."""

RENDER_VERSION = "8"
