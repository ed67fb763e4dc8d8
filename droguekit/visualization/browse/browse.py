"""From a dataset to a page: every pair in worker processes, then the page around them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datasets_manifest.storage.storage import Location, absolute
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from droguekit.batch.progress import ProgressReport
from droguekit.batch.workers import is_accident, run_tasks
from droguekit.benchmark.poses.pose_errors import by_method
from droguekit.visualization.browse.drogue_rings import Ring
from droguekit.visualization.browse.frame_entry import FrameEntry, picture_files, with_answers, write_pictures
from droguekit.visualization.browse.page import PICTURES_FOLDER, Skipped, opened_page, write_labels, write_page
from droguekit.visualization.browse.source import PairSource, open_source


@dataclass(frozen=True)
class BrowseSummary:
    """What a run did.

    Attributes:
        shown: pairs on the page.
        kept: of these, pairs whose pictures were there already.
        skipped: pairs that could not be read.
    """

    shown: int
    kept: int
    skipped: tuple[Skipped, ...]


def write_browse(
    dataset: Location, out: Path, estimates: Path | None, workers: int, report: ProgressReport
) -> BrowseSummary:
    """Write the page of a dataset; pictures of an earlier run that are still right stay.

    Args:
        dataset: folder or URL.
        out: the page's folder, new or of an earlier run.
        estimates: poses to show beside the truth, or None.
        workers: processes; 0 works in this one.
        report: hears how it goes.

    Raises:
        ValueError: dataset or estimates cannot be used, or the folder holds other things or is written by another run.
        OSError: the page cannot be written.
    """
    source = open_source(absolute(dataset))
    indices = source.frame_indices()
    if not indices:
        raise ValueError(f"{dataset}: holds no pairs yet")
    answers = {} if estimates is None else by_method(_lean(estimates), indices, str(estimates))
    with opened_page(out):
        return _write(source, out, answers, workers, report)


def _write(
    source: PairSource, out: Path, answers: Mapping[str, Mapping[int, Estimate]], workers: int, report: ProgressReport
) -> BrowseSummary:
    indices = source.frame_indices()
    make = _FrameWork(source, out.resolve())
    rows: dict[int, dict[str, Any]] = {}
    drogues: set[tuple[Ring, ...]] = set()
    skipped: dict[int, Skipped] = {}
    kept = 0
    report.begin("pairs", len(indices))
    try:
        with closing(run_tasks(make, indices, workers)) as attempts:
            for attempt in attempts:
                index = attempt.index
                if attempt.value is not None:
                    entry, was_there = attempt.value
                    entry = with_answers(entry, [frames.get(index) for frames in answers.values()])
                    rows[index] = entry.row | {"labels": write_labels(out, index, entry.labels)}
                    kept += was_there
                    drogues.add(entry.rings)
                elif attempt.final:
                    skipped[index] = Skipped(index, _reason(attempt.error))
                    report.note(f"{len(skipped)} skipped")
                if attempt.final:
                    report.advance()
    finally:
        report.end()
    left_out = tuple(skipped[index] for index in sorted(skipped))
    write_page(out, source.facts(), [rows[index] for index in sorted(rows)], drogues, list(answers), left_out)
    return BrowseSummary(len(rows), kept, left_out)


class _FrameWork:
    """What a worker does with one pair."""

    def __init__(self, source: PairSource, out: Path) -> None:
        self._source, self._out = source, out

    def __call__(self, frame_index: int) -> tuple[FrameEntry, bool]:
        """Write a pair's pictures, unless they are there.

        Returns:
            What the page says of it, and whether its pictures were there.
        """
        entry = self._source.entry(frame_index)
        files = picture_files(self._out / PICTURES_FOLDER, entry.row["picture"])
        was_there = all(path.is_file() for path in files)
        if not was_there:
            write_pictures(files, self._source.images(frame_index))
        return entry, was_there


def _lean(path: Path) -> Iterator[Estimate]:
    """Estimates without what the page does not show: a file of them may be large."""
    for estimate in read_estimates(path):
        dropped: dict[str, Any] = {"stage_s": {}, "regions": ()}
        if isinstance(estimate, PoseEstimate):
            dropped |= {"covariance": None, "modes": (), "motion": None, "docking": None}
        yield estimate.model_copy(update=dropped)


def _reason(error: BaseException | None) -> str:
    """Why a pair is skipped, on one line.

    Raises:
        BaseException: it is no fault of the pair, such as a full disk, and ends the run.
    """
    if error is not None and not (isinstance(error, ValueError) or is_accident(error)):
        raise error
    return " ".join(str(error).split())
