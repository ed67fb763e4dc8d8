"""Keyed random streams: every draw follows from (dataset seed, index, name of the stream)."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, index: int, stream: str) -> np.random.Generator:
    """The stream named `stream` of frame (or scene) `index`.

    Adding a new stream changes none of the others; 0 is a seed like any other.

    Raises:
        ValueError: a negative seed or index.
    """
    return np.random.Generator(np.random.Philox(_sequence(seed, index, stream)))


def bulk_generator(seed: int, index: int, stream: str) -> np.random.Generator:
    """The same for millions of draws: SFC64 is three times as fast as Philox at float32 normals.

    Raises:
        ValueError: a negative seed or index.
    """
    return np.random.Generator(np.random.SFC64(_sequence(seed, index, stream)))


def _sequence(seed: int, index: int, stream: str) -> np.random.SeedSequence:
    if seed < 0 or index < 0:
        raise ValueError(f"seed, index: must not be negative, got {seed}, {index}")
    key = (seed & 0xFFFFFFFF, seed >> 32, index & 0xFFFFFFFF, index >> 32, zlib.crc32(stream.encode()))
    return np.random.SeedSequence(key)
