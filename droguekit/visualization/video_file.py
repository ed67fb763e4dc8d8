"""Write pictures as GIF or MP4, and choose which pairs of a dataset to show and for how long."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from datasets_manifest.atomic import part_path
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.report.label_drawing import Picture, resized
from droguekit.scoring.report.number_text import plain_number

_SUFFIXES = (".gif", ".mp4")
_MOST_PICTURES = 2000
# Time of a picture where pairs do not follow each other in time.
_SLIDE_S = 0.5
_FASTEST_S, _SLOWEST_S = 0.02, 2.0
# GIF stores times in hundredths of a second.
_GIF_TICK_MS = 10
_GIF_COLORS, _GIF_WIDTH_PX = 128, 960


def write_video(path: Path, pictures: Iterable[Picture], picture_s: float) -> None:
    """Write pictures of one size as GIF or MP4; the file appears when it is complete.

    Args:
        path: ends in .gif or .mp4.
        pictures: (H, W, 3) each, at least one.
        picture_s: time that each is shown. [s]

    Raises:
        ValueError: the package that writes MP4 is missing.
        OSError: it cannot be written; one line that names it. Nothing is left behind.
    """
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    part = part_path(path)
    part = part.with_name(part.name + path.suffix.lower())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(part, pictures, picture_s)
        part.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def check_video(option: str, path: Path, count: int) -> None:
    """Check that a video can be made, before its pictures are drawn.

    Raises:
        ValueError: too many pictures or none, or a file of another kind; names the command's option.
    """
    if not 1 <= count <= _MOST_PICTURES:
        raise ValueError(f"--count: must be from 1 to {_MOST_PICTURES} in a video, got {count}")
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"{option}: must end in {' or '.join(_SUFFIXES)}, got {path}")


def evenly(indices: Sequence[int], count: int) -> list[int]:
    """Up to `count` of them, spread evenly, in order."""
    places = np.linspace(0, len(indices) - 1, min(count, len(indices))).round()
    return [indices[int(place)] for place in places]


class WrittenVideo(NamedTuple):
    """What a video shows.

    Attributes:
        pairs: number of its pictures.
        length_s: its length. [s]
        pace: how many times as fast as it flew a sequence goes by; 1 where pairs do not follow each other.
    """

    pairs: int
    length_s: float
    pace: float

    @property
    def pace_text(self) -> str:
        """The pace in words; empty where it is that of the flight."""
        pace = plain_number(float(f"{self.pace:.2g}"))
        return "" if pace == "1" else f", {pace} times as fast as it flew"


def write_pairs(path: Path, pictures: Iterable[Picture], records: Sequence[PairRecord]) -> WrittenVideo:
    """Write a picture of each pair, in the time of their sequences as far as a viewer can follow it; see `write_video`.

    Args:
        path: ends in .gif or .mp4.
        pictures: (H, W, 3) each.
        records: of the same pairs.
    """
    own = [
        b.time_s - a.time_s
        for a, b in pairwise(records)
        if a.sequence_id is not None and a.sequence_id == b.sequence_id
    ]
    picture_s, pace = _SLIDE_S, 1.0
    if own:
        own_s = float(np.median(own))
        picture_s = float(np.clip(own_s, _FASTEST_S, _SLOWEST_S))
        pace = own_s / picture_s
    write_video(path, pictures, picture_s)
    return WrittenVideo(len(records), len(records) * picture_s, pace)


def _write_gif(path: Path, pictures: Iterable[Picture], picture_s: float) -> None:
    frames = [_with_palette(picture) for picture in pictures]
    tick_ms = max(2 * _GIF_TICK_MS, round(1000 * picture_s / _GIF_TICK_MS) * _GIF_TICK_MS)
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=tick_ms, loop=0)


def _with_palette(picture: Picture) -> Image.Image:
    """A smaller picture in few colours, chosen by an octree, which keeps those of small red markers."""
    small, _ = resized(picture, _GIF_WIDTH_PX)
    return Image.fromarray(small).quantize(_GIF_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def _write_mp4(path: Path, pictures: Iterable[Picture], picture_s: float) -> None:
    """H.264 in yuv420p with its index in front, which browsers play.

    Raises:
        ValueError: PyAV is missing.
        OSError: a write failed.
    """
    try:
        import av
    except ImportError as error:
        raise ValueError("an .mp4 file needs PyAV: pip install 'droguekit[video]', or write a .gif file") from error
    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
            rate = Fraction(1.0 / picture_s).limit_denominator(1000)
            stream = container.add_stream("libx264", rate=rate, options={"crf": "18"})
            stream.pix_fmt = "yuv420p"
            for place, picture in enumerate(pictures):
                frame = av.VideoFrame.from_ndarray(_with_even_sides(picture), format="rgb24")
                if place == 0:
                    stream.width, stream.height = frame.width, frame.height
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    except av.FFmpegError as error:
        raise OSError(error.errno, error.strerror) from error


def _with_even_sides(picture: Picture) -> Picture:
    """The picture with its last row or column doubled where their number is odd: yuv420p halves both sides."""
    height, width = picture.shape[:2]
    even: Picture = np.ascontiguousarray(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))
    return even
