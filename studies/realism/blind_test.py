"""A blind test: people or programs say of mixed pictures, ours and photographs, which are photographs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.importers.photographs import shown_photograph
from datasets_manifest.recipe.recipe import Recipe
from drogue_models.untrusted_files import parse_json, read_regular, read_text
from droguekit.scoring.report.label_drawing import display_picture
from render.analytic_engine.analytic_engine import AnalyticEngine
from render.camera.sensor import expose
from scenes.sampler import sample_frame

WIDTH_PX, HEIGHT_PX = 640, 480
KEY_FILE = "key.json"
# A window shows at least this share of a photograph's width or height, and more of a small one, so that it need not be
# enlarged.
_LEAST_SHARE = 0.45
# Smaller pictures have no part of 4:3.
_LEAST_PX = 4
_KINDS = ("ours", "photograph")

Picture = NDArray[np.uint8]


def surroundings_frame(recipe: Recipe, frame_index: int) -> Picture:
    """(480, 640, 3) blue, green, red: the left picture of a frame without any object, through its camera, for a screen.

    Text that a camera lays over its picture is left out.
    """
    frame = sample_frame(recipe, frame_index)
    camera = frame.camera and frame.camera.model_copy(update={"overlay": None})
    alone = frame.model_copy(
        update={"drogue": None, "left_from_drogue": None, "board": None, "neighbours": (), "camera": camera}
    )
    images = expose(alone, AnalyticEngine().render(alone, recipe.render))
    return _fitted(cv2.cvtColor(display_picture(images), cv2.COLOR_RGB2BGR).astype(np.uint8))


def photograph_window(picture: Picture, rng: np.random.Generator) -> Picture:
    """(480, 640, 3) part of a photograph at a random place."""
    height, width = picture.shape[:2]
    most = min(width / WIDTH_PX, height / HEIGHT_PX)
    scale = max(most * rng.uniform(_LEAST_SHARE, 1.0), min(most, 1.0))
    part = max(int(scale * WIDTH_PX), 1), max(int(scale * HEIGHT_PX), 1)
    x, y = (int(rng.integers(0, size - own + 1)) for size, own in zip((width, height), part, strict=True))
    return _fitted(picture[y : y + part[1], x : x + part[0]])


def make_test(recipe: Recipe, photographs: Sequence[Path], count: int, out: Path, seed: int) -> None:
    """Write `count` pictures of ours and as many windows of photographs, mixed, as 01.png, 02.png, ... and their key.

    Args:
        recipe: whose scenes ours are of, spread over all of them.
        photographs: taken in turn.
        count: of either.
        out: a folder that is not there yet.
        seed: of windows and order.

    Raises:
        ValueError: a photograph cannot be read or is tiny, there is none, or a number is out of range.
        OSError: the folder exists or cannot be written.
    """
    if not photographs:
        raise ValueError("--photographs: must name at least one picture")
    if count < 1:
        raise ValueError(f"--count: must be at least 1, got {count}")
    if seed < 0:
        raise ValueError(f"--seed: must not be negative, got {seed}")
    rng = np.random.default_rng(seed)
    # First, so that a picture that cannot be read leaves no folder behind.
    taken = [photographs[index % len(photographs)] for index in range(count)]
    windows = [photograph_window(_photograph(path), rng) for path in taken]
    out.mkdir(parents=True)
    mixed: list[tuple[str, Picture]] = []
    for index, (path, window) in enumerate(zip(taken, windows, strict=True)):
        mixed.append((f"photograph {path.name}", window))
        frame_index = index * recipe.frames.count // count
        mixed.append((f"ours {recipe.name} frame {frame_index}", surroundings_frame(recipe, frame_index)))
    key = {}
    for number, which in enumerate(rng.permutation(len(mixed)), start=1):
        name, picture = mixed[which]
        key[f"{number:02d}"] = name
        (out / f"{number:02d}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    (out / KEY_FILE).write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")


def score(key_file: Path, answers: Sequence[Path]) -> str:
    """A table in Markdown: which share of ours and of the photographs each judge calls photographs.

    Args:
        key_file: as `make_test` writes it, kept from the judges.
        answers: a CSV file of each judge, with the columns `number` and `answer`: `photograph` or `render`.

    Raises:
        ValueError: the key is none, or a number or an answer is missing or unknown; names the file.
        OSError: a file cannot be read.
    """
    key = _read_key(key_file)
    rows = ["| judge | ours called photographs | photographs called photographs |", "|---|---|---|"]
    for path in answers:
        try:
            lines = csv.DictReader(io.StringIO(read_text(path), newline=""))
            rows_said = [(row.get("number") or "", row.get("answer") or "") for row in lines]
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: is no CSV file in UTF-8; save it as one ({error})") from error
        said = {number.strip().zfill(2): answer.strip() for number, answer in rows_said}
        if said.keys() != key.keys() or not set(said.values()) <= {"photograph", "render"}:
            raise ValueError(f"{path}: must say photograph or render of each number from 01 to {len(key):02d}")
        cells = []
        for kind in _KINDS:
            told = [said[number] == "photograph" for number, name in key.items() if name.startswith(kind)]
            cells.append(f"{sum(told)} of {len(told)} ({100 * float(np.mean(told)):.0f} %)")
        rows.append(f"| {path.stem} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _read_key(path: Path) -> dict[str, str]:
    """Names of the pictures by their numbers, as `make_test` writes them."""
    try:
        key = parse_json(read_regular(path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}; give the {KEY_FILE} that blind-test wrote") from error
    names = list(key.values()) if isinstance(key, dict) else []
    if not all(isinstance(name, str) and name.startswith(_KINDS) for name in names) or any(
        not any(name.startswith(kind) for name in names) for kind in _KINDS
    ):
        raise ValueError(f"{path}: is no key of a blind test; give the {KEY_FILE} that blind-test wrote")
    return dict(key)


def _photograph(path: Path) -> Picture:
    """(H, W, 3) blue, green, red."""
    picture = shown_photograph(path)
    if min(picture.shape[:2]) < _LEAST_PX:
        raise ValueError(f"{path}: must be at least {_LEAST_PX} px wide and high, got {picture.shape[1::-1]}")
    code = cv2.COLOR_GRAY2BGR if picture.ndim == 2 else cv2.COLOR_RGB2BGR
    return np.asarray(cv2.cvtColor(picture, code), dtype=np.uint8)


def _fitted(picture: NDArray[np.uint8]) -> Picture:
    """The middle of a picture, 4:3, at the size of the test."""
    height, width = picture.shape[:2]
    part_width, part_height = min(width, height * WIDTH_PX // HEIGHT_PX), min(height, width * HEIGHT_PX // WIDTH_PX)
    x, y = (width - part_width) // 2, (height - part_height) // 2
    part = picture[y : y + part_height, x : x + part_width]
    smaller = part_width > WIDTH_PX
    method = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    fitted: Picture = cv2.resize(part, (WIDTH_PX, HEIGHT_PX), interpolation=method).astype(np.uint8)
    return fitted
