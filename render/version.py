"""The version of the pixels: changed whenever the same recipe and frame give other pixels than before."""

RENDER_VERSION = "8"
