"""One frame from the recipe to its files: the unit of work that a worker process repeats.

`reproduce_frame` makes a frame of a dataset once more, and compares it with the stored one. `make_drop` takes an error
that ends a single frame; others end the run, because other frames would fail too.
"""

from __future__ import annotations

import hashlib
import json
import math
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Literal

import cv2

from datasets_manifest.atomic import scratch_folder
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.image_codecs import encode_passes
from datasets_manifest.storage.layout import RECORD_FILE, frame_folder, passes_file
from datasets_manifest.storage.manifest import Drop, cpu_features, differing_builds, software_versions
from datasets_manifest.storage.packing import Packing, pack_if_complete
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import encode_files, write_frame
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.untrusted_files import parse_json
from droguekit.batch.worker_pool import run_in_own_process
from geometry.stereo import EYES, Eye
from labelgen.frame_labels import label_frame
from labelgen.validation.label_checks import check_against_passes
from render.camera.sensor import expose
from render.device import Device
from render.engine import EngineUnavailableError, EyeRadiance, RenderEngine, StereoRadiance, load_engine
from scenes.sampler import sample_frame


class FrameFaultError(ValueError):
    """Labels and rendered passes of a frame disagree; the frame is not written."""


class OtherBuildError(ValueError):
    """Software or processor differ from those that make the other frames of the dataset."""


@dataclass(frozen=True)
class FrameTask:
    """Makes frames of a recipe and writes them into a dataset; calling it with an index makes that frame.

    Attributes:
        recipe: what to make.
        dataset: its place.
        engine_version: of the existing frames, or None when there are none.
        packing: which frames share a tar file, or None where each keeps its folder.
        device: that the engine renders on.
    """

    recipe: Recipe
    dataset: Location
    engine_version: str | None = None
    packing: Packing | None = None
    device: Device = "cpu"

    def __call__(self, frame_index: int) -> FrameReport:
        """Make and write frame `frame_index`.

        Raises:
            FrameFaultError: its labels contradict its passes.
            EngineUnavailableError: the engine cannot be used.
            OtherBuildError: it is not the one that made the other frames.
            OSError: the frame could not be written; nothing of it is left.
        """
        engine = process_engine(self.recipe.render.engine, self.device)
        if self.engine_version not in (None, engine.version):
            raise OtherBuildError(
                f"{self.dataset}: its frames were made by {self.engine_version}, but this is {engine.version}, whose "
                "pixels differ; continue where they were made, or render into a new folder"
            )
        began_s = time.monotonic()
        try:
            record, files, stage_s = make_frame(self.recipe, frame_index, engine)
        except OSError as error:
            # Engines and encoders use temporary files.
            where = error.filename or tempfile.gettempdir()
            raise OSError(error.errno, f"frame {frame_index}: cannot be made: {where}: {error.strerror}") from error
        with _timed(stage_s, "write"):
            write_frame(self.dataset, record, files)
        distance_m = record.conditions.distance_m
        size_bytes = sum(len(content) for content in files.values())
        return FrameReport(socket.gethostname(), time.monotonic() - began_s, stage_s, distance_m, size_bytes)

    def pack(self, frame_index: int, report: FrameReport) -> FrameReport:
        """Pack the tar file that a frame completes, if it does.

        This is a separate step because it may take longer than the time limit of a frame.

        Args:
            frame_index: of the frame, which exists.
            report: of the frame.

        Returns:
            The report with the time of packing added.

        Raises:
            OSError: the tar file could not be written; the frames stay as they are.
        """
        if self.packing is None:
            return report
        began_s, stage_s = time.monotonic(), dict(report.stage_s)
        with _timed(stage_s, "write"):
            pack_if_complete(self.dataset, frame_index, self.packing)
        return replace(report, wall_s=report.wall_s + time.monotonic() - began_s, stage_s=stage_s)


@dataclass(frozen=True)
class FrameReport:
    """Time and size of one frame.

    Attributes:
        host: name of the machine.
        wall_s: from start to end, with the engine loaded. [s]
        stage_s: CPU seconds by stage. [s]
        distance_m: of the drogue, None in an empty frame. [m]
        size_bytes: of its files without the record.
    """

    host: str
    wall_s: float
    stage_s: dict[str, float]
    distance_m: float | None
    size_bytes: int


@dataclass(frozen=True, eq=False)
class RenderedPair:
    """A stereo pair in memory.

    Attributes:
        record: the truth, without the hashes of files.
        images: of both cameras.
        radiance: that the images were exposed from, with the passes.
        stage_s: CPU seconds by stage. [s]
    """

    record: PairRecord
    images: StereoImages
    radiance: StereoRadiance
    stage_s: dict[str, float]


def render_frame(recipe: Recipe, frame_index: int, engine: RenderEngine) -> RenderedPair:
    """Render and label a frame.

    Raises:
        FrameFaultError: the labels contradict the rendered passes.
        ValueError: an index outside the recipe.
    """
    stage_s: dict[str, float] = {}
    with _timed(stage_s, "sample"):
        frame = sample_frame(recipe, frame_index)
    radiance = engine.render(frame, recipe.render)
    stage_s.update(radiance.stage_s)
    with _timed(stage_s, "sensor"):
        images = expose(frame, radiance)
    with _timed(stage_s, "labels"):
        record = label_frame(frame, radiance, images)
        faults = check_against_passes(record, radiance)
    if faults:
        raise FrameFaultError(f"labels and rendered passes disagree: {'; '.join(faults)}")
    return RenderedPair(record, images, radiance, stage_s)


def make_frame(
    recipe: Recipe, frame_index: int, engine: RenderEngine
) -> tuple[PairRecord, dict[str, bytes], dict[str, float]]:
    """A frame's record and files in memory.

    Returns:
        Its record (without the hashes of its files), its files by name, and CPU seconds by stage.

    Raises:
        FrameFaultError: the labels contradict the rendered passes.
    """
    rendered = render_frame(recipe, frame_index, engine)
    stage_s, radiance = rendered.stage_s, rendered.radiance
    with _timed(stage_s, "encode"):
        files = encode_files(rendered.images, {eye: eye_radiance(radiance, eye).part_id for eye in EYES})
        if recipe.outputs.exr:
            files.update({passes_file(eye): encode_passes(eye_radiance(radiance, eye)) for eye in EYES})
    return rendered.record, files, stage_s


def eye_radiance(radiance: StereoRadiance, eye: Eye) -> EyeRadiance:
    """What one eye would see."""
    return radiance.left if eye == "left" else radiance.right


@cache
def process_engine(name: str, device: Device = "cpu") -> RenderEngine:
    """The engine of this process, loaded once and used with one thread, on which the sameness of pixels rests.

    Raises:
        EngineUnavailableError: no such engine, or it cannot be used here.
    """
    cv2.setNumThreads(1)
    return load_engine(name, device)


@contextmanager
def _timed(stage_s: dict[str, float], stage: str) -> Iterator[None]:
    began_s = time.process_time()
    yield
    stage_s[stage] = stage_s.get(stage, 0.0) + time.process_time() - began_s


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


def reproduce_frame(dataset: Location, frame_index: int, device: Device = "cpu") -> Reproduction:
    """Make a frame of a dataset again, from the manifest alone, and compare record and files.

    Args:
        dataset: its place.
        frame_index: of the frame.
        device: that the engine renders on.

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
    old = parse_json(source.frames.read(frame_index, RECORD_FILE))
    new, record_sha256 = run_in_own_process(partial(_make_again, source.manifest.recipe, frame_index, device))
    expected = next(entry.record_sha256 for entry in source.manifest.frames if entry.frame_index == frame_index)
    # The record holds the hashes of all other files.
    if record_sha256 == expected:
        return Reproduction("identical", (), ())
    build_differences = _build_differences(source, old, new)
    differences = _differences(old, new, pixels_too=not build_differences)
    return Reproduction(
        "equivalent" if build_differences and not differences else "different", differences, build_differences
    )


def _make_again(recipe: Recipe, frame_index: int, device: Device) -> tuple[dict[str, Any], str]:
    """Make the frame in a new folder: its record, and the hash of the record's file."""
    with scratch_folder() as folder:
        FrameTask(recipe, folder, device=device)(frame_index)
        data = (frame_folder(folder, frame_index) / RECORD_FILE).read_bytes()
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


# Errors of machine or storage, which other frames would meet too.
FATAL_ERRORS = (OSError, EngineUnavailableError, OtherBuildError)
# If so many first frames of a run all fail, whatever the error, the recipe is at fault.
FIRST_FRAMES = 3


def error_reason(error: BaseException) -> str:
    """The message of an error on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def make_drop(frame_index: int, error: BaseException) -> Drop:
    """Record that a frame is dropped because of an error."""
    return Drop(frame_index=frame_index, reason=error_reason(error))
