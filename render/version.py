"""The version of the pixels: it changes whenever the same recipe and frame give other pixels than before."""

from __future__ import annotations

RENDER_VERSION = "22"
