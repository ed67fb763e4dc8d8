"""A dataset with estimates on it and its page, and what the tests of that page do in it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, Feature, NoFix, PoseEstimate, write_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.batch.progress import PlainProgress
from droguekit.visualization.browse.page import write_browse
from geometry.se3 import RigidTransform
from tests.support.recipe_builder import between, recipe_text
from tests.support.small_datasets import rendered

# Real lenses: an overlay that knew only the ideal camera would be off by pixels.
RECIPE = recipe_text(
    name="page",
    seed=4,
    rig={"preset": "paper-real", "width_px": 320, "height_px": 240, "focal_px": 533.0},
    frames={"count": 12, "scenes": 4, "empty_fraction": 0.2},
    distance=between(1.9, 9.0, "log-uniform"),
    split={"train": 0.5, "val": 0.25, "test": 0.25},
    render={"engine": "analytic"},
    families=[
        {"name": "clear", "weight": 1, "environment": {"sun_elevation_deg": [20, 60]}},
        {"name": "low-light", "weight": 1, "environment": {"sun_elevation_deg": [-8, -2]}},
    ],
)
PAIRS = 12
OTHER = "</script><img src=x onerror=alert(1)>"
ERRORS_M = 1e-3 * np.array([0.0, 1.0, 0.5])
# Names that a script's objects have already.
HOSTILE = ("__proto__", "constructor")


class BrowsedDataset(NamedTuple):
    """A folder with a dataset, its page and the estimates on it by method and frame."""

    folder: Path
    records: dict[int, PairRecord]
    splits: dict[int, str]
    page: Path
    estimates: dict[str, dict[int, Estimate]]


def invent_estimate(record: PairRecord, method: str) -> Estimate:
    """A pose that is off by more in later frames; every fifth is no fix, and so is that of an empty frame."""
    index, pose = record.frame_index, record.left_from_drogue
    if pose is None or index % 5 == 4:
        return NoFix(frame_index=index, method=method, reason="<i>nothing</i> seen")
    moved = RigidTransform(pose.rotation, pose.translation_m + index * ERRORS_M * (1 if method == "own" else -2))
    features = [
        Feature(eye="right", index=k, center_px=marker.center_ellipse_px, cov_px2=((1, 0), (0, 1)), used=k > 0)
        for k, marker in enumerate(record.views.right.markers)
    ]
    return PoseEstimate(frame_index=index, method=method, left_from_drogue=moved, features=tuple(features))


def browse_dataset(folder: Path) -> None:
    """Render the pairs, invent estimates of several methods on them, and write the page of both."""
    rendered(RECIPE, folder / "dataset")
    estimates = open_browsed(folder).estimates
    write_estimates(folder / "e.jsonl", [estimate for found in estimates.values() for estimate in found.values()])
    summary = write_browse(folder / "dataset", folder / "page", folder / "e.jsonl", 0, PlainProgress(io.StringIO()))
    assert (summary.shown, summary.skipped) == (PAIRS, ())


def open_browsed(folder: Path) -> BrowsedDataset:
    """What `browse_dataset` has made there."""
    dataset = Dataset(folder / "dataset")
    records = {index: dataset.record(index) for index in dataset.frame_indices}
    estimates = {m: {i: invent_estimate(r, m) for i, r in records.items()} for m in ("own", OTHER, *HOSTILE)}
    splits = dict(dataset.manifest.split_of_frame())
    return BrowsedDataset(folder, records, splits, folder / "page" / "index.html", estimates)


def shown_frames(page: Any) -> list[int]:
    return [int(frame) for frame in page.eval_on_selector_all("#tiles a", "all => all.map(a => a.dataset.frame)")]


def show(page: Any, frame: int, *wanted: str) -> None:
    """Open a pair and tick all layers; wait until its labels are drawn."""
    page.evaluate(f"location.hash = 'frame={frame}'")
    page.wait_for_selector(f"#left[aria-label^='Frame {frame},']", state="attached")
    for name in wanted:
        page.check(f"[name={name}]")
