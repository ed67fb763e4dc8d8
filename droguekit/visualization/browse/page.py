"""A dataset as a page for a browser: pictures, labels and a catalogue beside a page that reads them without a server.

Every pair is drawn in worker processes, then the page is written around them. A browser lets a page from the file
system load pictures and scripts of its own folder, but read no other file. So all data are scripts, which hand over
what is in them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from datasets_manifest.atomic import PART_SUFFIX, try_lock, write_bytes_unsynced, write_text_atomic
from datasets_manifest.storage.storage import Location, absolute
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from droguekit.batch.progress import ProgressReport
from droguekit.batch.worker_pool import WorkerLimits, is_accident, run_tasks
from droguekit.scoring.poses.pose_errors import estimates_by_method
from droguekit.visualization.browse.pairs import (
    LIGHTS,
    BrowsedPairs,
    PageEntry,
    PageFacts,
    is_whole_picture,
    open_browsed_pairs,
    picture_files,
    rings_name,
    with_estimates,
    write_pictures,
)
from droguekit.visualization.drogue_outlines import Ring
from geometry.stereo import StereoRig

MARK_FILE = ".droguekit-browse"
_MARK = "Written by `droguekit browse`, which may replace or remove anything in this folder.\n"
SITE_FOLDER, DATA_FOLDER, PICTURES_FOLDER = "site", "data", "pictures"
_SCRIPTS = ("projection.js", "overlay.js", "catalogue.js", "single.js", "page.js")


@dataclass(frozen=True)
class UnreadablePair:
    """A pair that is not on the page, and the reason."""

    frame_index: int
    reason: str


@contextmanager
def lock_page_folder(out: Path) -> Iterator[None]:
    """Make the page's folders or reuse those of an earlier run, and keep other runs out of them.

    Raises:
        ValueError: a folder with other things in it, or that another run is writing into.
        OSError: it cannot be written.
    """
    if out.exists() and not _is_ours(out):
        raise ValueError(f"{out}: exists already and is no page of this command; name a new folder")
    folders = [out / name for name in (SITE_FOLDER, DATA_FOLDER, PICTURES_FOLDER)]
    for path in (out / MARK_FILE, *folders):
        if path.is_symlink():
            raise ValueError(
                f"{path}: is a link, and nothing outside the folder is written or removed; name a new folder"
            )
    with ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            mark = stack.enter_context((out / MARK_FILE).open("a", encoding="utf-8"))
            if not try_lock(mark):
                raise ValueError(f"{out}: another run is writing into it; wait for its end, or name another one")
            if not mark.tell():
                mark.write(_MARK)
                mark.flush()
            for folder in folders:
                folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OSError(error.errno, f"{out}: cannot be written: {error.strerror or error}") from error
        yield


def _is_ours(out: Path) -> bool:
    """Whether a folder is a page, has only leftovers of an unfinished one, or is empty."""
    if not out.is_dir():
        return False
    others = [path for path in out.iterdir() if not path.name.endswith(PART_SUFFIX)]
    return not others or (out / MARK_FILE).is_file()


def write_labels(out: Path, frame_index: int, labels: dict[str, Any]) -> str:
    """Write the file that the page loads when it enlarges a pair.

    Returns:
        The file's name without suffix. It contains the hash of the content: until the catalogue is replaced, the page
        keeps using the files that the old one names.

    Raises:
        OSError: it cannot be written.
    """
    text = _json(labels)
    name = f"{frame_index:06d}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    write_bytes_unsynced(_labels_file(out, name), f'droguekit.receive("{name}", {text});\n'.encode())
    return name


def write_page(
    out: Path, facts: PageFacts, rows: Sequence[dict[str, Any]], drogues: Iterable[tuple[Ring, ...]],
    methods: Sequence[str], skipped: Sequence[UnreadablePair],
) -> None:  # fmt: skip
    """Write the catalogue and the page, and remove files of earlier runs that it does not use.

    Args:
        out: the page's folder.
        facts: of the dataset.
        rows: of the catalogue, by frame.
        drogues: circles of every drogue, in any order.
        methods: names of the methods with estimates.
        skipped: pairs that could not be read.

    Raises:
        OSError: something cannot be written.
    """
    camera = facts.rig.camera
    catalogue = {
        "is_blind": facts.is_blind,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "rig": _rig_table(facts.rig),
        "drogues": {rings_name(rings): [ring._asdict() for ring in rings] for rings in sorted(drogues)},
        "lights": LIGHTS,
        "methods": list(methods),
        "rows": list(rows),
    }
    write_text_atomic(out / DATA_FOLDER / "catalogue.js", f"droguekit.catalogue = {_json(catalogue)};\n")
    _write_site(out, facts, skipped)
    _remove_stale_files(out, rows)


def _write_site(out: Path, facts: PageFacts, skipped: Sequence[UnreadablePair]) -> None:
    folder = files(__package__) / SITE_FOLDER
    for name in ("browse.css", *_SCRIPTS):
        write_text_atomic(out / SITE_FOLDER / name, (folder / name).read_text(encoding="utf-8"))
    environment = Environment(
        loader=PackageLoader(__package__, SITE_FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("index.html.j2").render(facts=facts, skipped=skipped, scripts=_SCRIPTS)
    write_text_atomic(out / "index.html", page)


def _remove_stale_files(out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Remove pictures and labels that the catalogue does not name; folders, such as those of a NAS, are not ours."""
    kept = {str(row["picture"]) for row in rows}
    for path in (out / PICTURES_FOLDER).iterdir():
        if path.name.rpartition("-")[0] not in kept and not path.is_dir():
            path.unlink()
    labels = {_labels_file(out, row["labels"]).name for row in rows} | {"catalogue.js"}
    for path in (out / DATA_FOLDER).iterdir():
        if path.name not in labels and not path.is_dir():
            path.unlink()


def _labels_file(out: Path, name: str) -> Path:
    return out / DATA_FOLDER / f"{name}.js"


def _rig_table(rig: StereoRig) -> dict[str, Any]:
    def intrinsics(camera: Any) -> dict[str, float]:
        return {name: getattr(camera, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}

    lenses = [
        {
            "camera": intrinsics(lens.camera),
            "distortion": lens.distortion.coefficients().tolist(),
            "real_from_ideal": lens.ideal_from_real.T.ravel().tolist(),
            "field": lens.field.tolist(),
        }
        for lens in rig.lenses or ()
    ]
    return {"camera": intrinsics(rig.camera), "baseline_m": rig.baseline_m, "lenses": lenses or None}


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))


@dataclass(frozen=True)
class BrowseSummary:
    """What a run did.

    Attributes:
        shown: pairs on the page.
        kept: how many of these had valid pictures from an earlier run.
        skipped: pairs that could not be read.
    """

    shown: int
    kept: int
    skipped: tuple[UnreadablePair, ...]


def write_browse(
    dataset: Location, out: Path, estimates: Path | None, workers: int, report: ProgressReport
) -> BrowseSummary:
    """Write the page of a dataset; valid pictures of an earlier run stay.

    Args:
        dataset: folder or URL.
        out: the page's folder, new or of an earlier run.
        estimates: poses to show beside the truth, or None.
        workers: processes; 0 runs in this one.
        report: is told of the progress.

    Raises:
        ValueError: dataset or estimates cannot be used, or the folder holds other things or is written by another run.
        OSError: the page cannot be written.
    """
    source = open_browsed_pairs(absolute(dataset))
    indices = source.frame_indices()
    if not indices:
        raise ValueError(f"{dataset}: holds no pairs yet")
    by_method = (
        {} if estimates is None else estimates_by_method(_without_unused_parts(estimates), indices, str(estimates))
    )
    with lock_page_folder(out):
        return _write(source, out, by_method, workers, report)


def _write(
    source: BrowsedPairs,
    out: Path,
    by_method: Mapping[str, Mapping[int, Estimate]],
    workers: int,
    report: ProgressReport,
) -> BrowseSummary:
    indices = source.frame_indices()
    make = _PictureTask(source, out.resolve())
    rows: dict[int, dict[str, Any]] = {}
    drogues: set[tuple[Ring, ...]] = set()
    skipped: dict[int, UnreadablePair] = {}
    kept = 0
    # A fresh process would read the manifest of all pairs again.
    limits = WorkerLimits(tasks_per_process=len(indices))
    report.begin("pairs", len(indices))
    try:
        with closing(run_tasks(make, indices, workers, limits)) as attempts:
            for attempt in attempts:
                index = attempt.index
                if attempt.value is not None:
                    entry, was_there = attempt.value
                    entry = with_estimates(entry, [frames.get(index) for frames in by_method.values()])
                    rows[index] = entry.row | {"labels": write_labels(out, index, entry.labels)}
                    kept += was_there
                    drogues.add(entry.rings)
                elif attempt.final:
                    skipped[index] = UnreadablePair(index, _reason(attempt.error))
                    report.note(f"{len(skipped)} skipped")
                if attempt.final:
                    report.advance()
    finally:
        report.end()
    left_out = tuple(skipped[index] for index in sorted(skipped))
    write_page(out, source.facts(), [rows[index] for index in sorted(rows)], drogues, list(by_method), left_out)
    return BrowseSummary(len(rows), kept, left_out)


class _PictureTask:
    """Writes the pictures of a pair, in a worker process."""

    def __init__(self, source: BrowsedPairs, out: Path) -> None:
        self._source, self._out = source, out

    def __call__(self, frame_index: int) -> tuple[PageEntry, bool]:
        """Write a pair's pictures, unless they exist.

        Returns:
            What the page shows of it, and whether its pictures existed.
        """
        entry = self._source.entry(frame_index)
        files = picture_files(self._out / PICTURES_FOLDER, entry.row["picture"])
        was_there = all(map(is_whole_picture, files))
        if not was_there:
            write_pictures(files, self._source.images(frame_index))
        return entry, was_there


def _without_unused_parts(path: Path) -> Iterator[Estimate]:
    """Estimates without the fields that the page does not show, to save memory."""
    for estimate in read_estimates(path):
        dropped: dict[str, Any] = {"stage_s": {}, "regions": ()}
        if isinstance(estimate, PoseEstimate):
            dropped |= {"covariance": None, "modes": (), "motion": None, "docking": None}
        yield estimate.model_copy(update=dropped)


def _reason(error: BaseException | None) -> str:
    """Why a pair is skipped, on one line.

    Raises:
        BaseException: the error itself if it is no fault of the pair, such as a full disk.
    """
    if error is not None and not (isinstance(error, ValueError) or is_accident(error)):
        raise error
    return " ".join(str(error).split())
