"""Render a frame of a dataset again, and compare it with the stored one."""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.layout import RECORD_FILE, frame_folder
from datasets_manifest.storage.provenance import cpu_features, differing_builds, software_versions
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from droguekit.batch.frame_task import FrameTask
from droguekit.batch.worker_pool import run_in_own_process

# Numbers that do not depend on rendered noise agree this well on any machine: numpy's exp, log, tan, arctan2 and
# matmul differ in their last bits between instruction sets.
_RELATIVE_TOLERANCE = 1e-9
# Keys that depend on pixels, which are equal only for the same engine, packages and processor features.
_FROM_PIXELS = {
    "file_sha256",
    "monte_carlo_noise_fraction",
    "monte_carlo_over_sensor_noise",
    "signal_to_noise",
    "background_luminance_cd_m2",
}
_FROM_HERE = {"engine", "engine_version"}


@dataclass(frozen=True)
class Reproduction:
    """The outcome of making a frame again.

    Attributes:
        verdict: `identical` bit for bit; `equivalent` if versions or processor differ, but draws are equal and numbers
            agree; or `different`.
        differences: keys at which the records differ by more than they may.
        build_differences: versions and processor features that differ from the dataset's.
    """

    verdict: Literal["identical", "equivalent", "different"]
    differences: tuple[str, ...]
    build_differences: tuple[str, ...]


def reproduce_frame(dataset: Location, frame_index: int) -> Reproduction:
    """Make a frame of a dataset again, from the manifest alone, and compare record and files.

    Raises:
        ValueError: no such dataset or frame, or its engine cannot be used here.
        OSError: the temporary folder cannot be written.
    """
    source = Dataset(dataset)
    if frame_index not in source.frame_indices:
        raise ValueError(f"frame: {dataset} has no frame {frame_index}")
    faults = source.verify(frame_index)
    if faults:
        return Reproduction("different", tuple(faults), ())
    old = json.loads(source.frames.read(frame_index, RECORD_FILE))
    new, record_sha256 = run_in_own_process(partial(_make_again, source.manifest.recipe, frame_index))
    expected = next(entry.record_sha256 for entry in source.manifest.frames if entry.frame_index == frame_index)
    # The record holds the hashes of all other files.
    if record_sha256 == expected:
        return Reproduction("identical", (), ())
    build_differences = _build_differences(source, old, new)
    differences = _differences(old, new, pixels_too=not build_differences)
    return Reproduction(
        "equivalent" if build_differences and not differences else "different", differences, build_differences
    )


def _make_again(recipe: Recipe, frame_index: int) -> tuple[dict[str, Any], str]:
    """Make the frame in a new folder: its record, and the hash of the record's file."""
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        FrameTask(recipe, Path(folder))(frame_index)
        data = (frame_folder(Path(folder), frame_index) / RECORD_FILE).read_bytes()
    return json.loads(data), hashlib.sha256(data).hexdigest()


def _build_differences(source: Dataset, old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, ...]:
    """Versions and processor features on which pixels depend and that differ from the manifest's."""
    manifest = source.manifest
    found = differing_builds(manifest.software, manifest.cpu_features, software_versions(), cpu_features())
    if old["engine_version"] != new["engine_version"]:
        found.append(f"{old['engine_version']} there, {new['engine_version']} here")
    return tuple(found)


def _differences(old: Any, new: Any, pixels_too: bool, where: str = "") -> tuple[str, ...]:
    """Dotted keys at which two JSON values differ beyond the tolerance, with both values."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        skip = set() if pixels_too else _FROM_PIXELS | _FROM_HERE
        return tuple(
            found
            for key in sorted({*old, *new} - skip)
            for found in _differences(old.get(key), new.get(key), pixels_too, f"{where}.{key}" if where else key)
        )
    if isinstance(old, Sequence) and isinstance(new, Sequence) and not isinstance(old, str) and len(old) == len(new):
        return tuple(
            found
            for index, pair in enumerate(zip(old, new, strict=True))
            for found in _differences(*pair, pixels_too, f"{where}[{index}]")
        )
    if isinstance(old, float) and isinstance(new, float) and not pixels_too:
        same = math.isclose(old, new, rel_tol=_RELATIVE_TOLERANCE, abs_tol=_RELATIVE_TOLERANCE)
    else:
        same = old == new
    return () if same else (f"{where}: {_shortened(old)} there, {_shortened(new)} here",)


def _shortened(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
