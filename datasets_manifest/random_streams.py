"""Keyed random streams: every draw depends on a key of numbers and names alone, not on earlier draws.

Streams are numpy's `SeedSequence` over 32-bit words: a seed takes two, a name one (its CRC-32).
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence

import numpy as np

_WORD = 0xFFFFFFFF


def frame_generator(seed: int, index: int, stream: str) -> np.random.Generator:
    """The stream named `stream` of frame (or scene) `index`.

    Adding a new stream changes none of the others; 0 is a seed like any other.

    Raises:
        ValueError: a negative seed or index.
    """
    return np.random.Generator(np.random.Philox(_frame_sequence(seed, index, stream)))


def bulk_frame_generator(seed: int, index: int, stream: str) -> np.random.Generator:
    """Like `frame_generator`, for millions of draws: SFC64 is three times as fast as Philox at float32 normals.

    Raises:
        ValueError: a negative seed or index.
    """
    return np.random.Generator(np.random.SFC64(_frame_sequence(seed, index, stream)))


def seeded_generator(seed: int, *names: str) -> np.random.Generator:
    """The stream of a seed and any number of names, independent of all streams of frames.

    Raises:
        ValueError: a negative seed.
    """
    return np.random.Generator(np.random.Philox(_sequence(seed, [_name_word(name) for name in names])))


def stream_seed(seed: int, name: str) -> int:
    """A seed of its own for each pair of a seed and a name, in [0, 2^52), which every reader of JSON keeps.

    Raises:
        ValueError: a negative seed.
    """
    if seed < 0:
        raise ValueError(f"seed: must not be negative, got {seed}")
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:8], "big") >> 12


def sample_generator(seed: int, epoch: int, sample: int, stream: str) -> np.random.Generator:
    """The stream named `stream` of one sample in one epoch of a training, for millions of draws.

    Raises:
        ValueError: a negative seed, epoch or sample.
    """
    if min(seed, epoch, sample) < 0:
        raise ValueError(f"seed, epoch, sample: must not be negative, got {seed}, {epoch}, {sample}")
    return np.random.Generator(np.random.SFC64(_sequence(seed, [epoch, sample, _name_word(stream)])))


def named_generator(name: str) -> np.random.Generator:
    """The stream of a name, without a seed."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(_name_word(name))))


def _frame_sequence(seed: int, index: int, stream: str) -> np.random.SeedSequence:
    if seed < 0 or index < 0:
        raise ValueError(f"seed, index: must not be negative, got {seed}, {index}")
    return _sequence(seed, [index & _WORD, index >> 32, _name_word(stream)])


def _sequence(seed: int, words: Sequence[int]) -> np.random.SeedSequence:
    if seed < 0:
        raise ValueError(f"seed: must not be negative, got {seed}")
    return np.random.SeedSequence((seed & _WORD, seed >> 32, *words))


def _name_word(name: str) -> int:
    return zlib.crc32(name.encode())
