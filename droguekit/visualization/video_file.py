"""Videos of pictures as GIF or MP4, and which pairs of a dataset they show for how long."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from datasets_manifest.atomic import part_path
from datasets_manifest.types.records import PairRecord
from droguekit.benchmark.report.label_drawing import Picture, resized

SUFFIXES = (".gif", ".mp4")
# Pairs that have nothing to do with each other are shown as single pictures.
_SLIDE_S = 0.5
_FASTEST_S, _SLOWEST_S = 0.02, 2.0
# Players of GIFs take time in hundredths of a second.
_GIF_TICK_MS = 10
_GIF_COLORS, _GIF_WIDTH_PX = 128, 960


def write_movie(path: Path, pictures: Iterable[Picture], picture_s: float) -> None:
    """Write pictures of one size as GIF or MP4, which takes its name when it is whole.

    Args:
        path: ends in .gif or .mp4.
        pictures: (H, W, 3) each, at least one.
        picture_s: time that each stands. [s]

    Raises:
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


def evenly(indices: Sequence[int], count: int) -> list[int]:
    """Up to `count` of them, spread evenly, in order."""
    places = np.linspace(0, len(indices) - 1, min(count, len(indices))).round()
    return [indices[int(place)] for place in places]


def period_s(records: Sequence[PairRecord]) -> float:
    """Time that each picture stands: as long as in flight for pairs of sequences. [s]"""
    if records[0].sequence_id is None or len(records) < 2:
        return _SLIDE_S
    return float(np.clip(np.median(np.diff([record.time_s for record in records])), _FASTEST_S, _SLOWEST_S))


def _write_gif(path: Path, pictures: Iterable[Picture], picture_s: float) -> None:
    frames = [_with_palette(picture) for picture in pictures]
    tick_ms = max(2 * _GIF_TICK_MS, round(1000 * picture_s / _GIF_TICK_MS) * _GIF_TICK_MS)
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=tick_ms, loop=0)


def _with_palette(picture: Picture) -> Image.Image:
    """A smaller picture in few colours, which an octree spreads over small red markers as well as over the sky."""
    small, _ = resized(picture, _GIF_WIDTH_PX)
    return Image.fromarray(small).quantize(_GIF_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def _write_mp4(path: Path, pictures: Iterable[Picture], picture_s: float) -> None:
    writer, written = None, 0
    for picture in pictures:
        height, width = picture.shape[:2]
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 1.0 / picture_s, (width, height))
            if not writer.isOpened():
                raise OSError(None, "OpenCV cannot write MP4 there; try .gif")
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        written += 1
    if writer is not None:
        writer.release()
    # OpenCV tells of no failed write: what is there is counted.
    reader = cv2.VideoCapture(str(path))
    found = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    reader.release()
    if found != written:
        raise OSError(None, f"only {found} of {written} pictures are in it; is the disk full?")
