"""Keyed random streams of a training: a draw follows from (seed, epoch, sample, name of the stream) alone."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, epoch: int, sample: int, stream: str) -> np.random.Generator:
    """The stream named `stream` of a sample; the same whichever thread asks, and whatever was drawn before.

    Raises:
        ValueError: a negative key.
    """
    if min(seed, epoch, sample) < 0:
        raise ValueError(f"seed, epoch, sample: must not be negative, got {seed}, {epoch}, {sample}")
    key = (seed & 0xFFFFFFFF, seed >> 32, epoch, sample, zlib.crc32(stream.encode()))
    # SFC64 is the fastest of numpy's at the millions of normals of sensor noise.
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))
