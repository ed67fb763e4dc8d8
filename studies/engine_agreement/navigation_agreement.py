"""Whether navigation errs alike on two engines' images of the same poses, light and sensor noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t

from datasets_manifest.recipe.recipe import Recipe, RecipeSource, load_recipe
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, write_estimates
from droguekit.batch.progress import ProgressReport
from droguekit.batch.render_dataset import render_dataset
from droguekit.scoring.confidence_intervals import CONFIDENCE, Interval, ratio_intervals
from droguekit.scoring.poses.pose_errors import COMPONENTS, pose_error
from geometry.se3 import Array
from nav.runner import navigate

METHOD = "joint"
RECIPE = "pose-tier-b"
STATIONS_M = (40.0, 28.0, 20.0, 14.0, 10.0, 7.0, 5.0)
# Samples with which the noise of each renderer is small beside that of the sensor, which is the same for both.
_SAMPLES_AT_5_M, _MOST_SAMPLES = 64, 576


@dataclass(frozen=True, eq=False)
class PairedErrors:
    """Pose errors at one distance, for pairs in which both engines' images gave a pose.

    Attributes:
        distance_m: of the drogue. [m]
        pairs: number of rendered pairs.
        one, other: (n, 5) errors of X, Y, Z [m], pitch and yaw [deg] by each engine.
    """

    distance_m: float
    pairs: int
    one: Array
    other: Array


@dataclass(frozen=True)
class SizeRatio:
    """Root mean square error by the second engine over that by the first, in the same pairs.

    Attributes:
        of: kind of error.
        n: number of pairs.
        ratio: of the root mean squares, with equal weight of each distance.
        interval: 95 % interval from resampled pairs; None with fewer than two.
    """

    of: str
    n: int
    ratio: float
    interval: Interval | None

    def beyond(self, low: float, high: float) -> float:
        """By how much the interval reaches beyond a range; 0 inside, infinite without an interval."""
        ends = self.interval or (-np.inf, np.inf)
        return max(low - ends[0], ends[1] - high, 0.0)


@dataclass(frozen=True)
class MeanDifference:
    """Mean difference of the engines' errors in one component.

    Attributes:
        of: the component.
        mean: second engine less the first, in units of their root mean square error at each distance.
        reach: half the width of the 95 % interval for all five components together.
    """

    of: str
    mean: float
    reach: float


def share_with_poses(stations: Sequence[PairedErrors]) -> float:
    """Share of the pairs in which both engines' images gave a pose; others have no error that could be compared."""
    return sum(len(s.one) for s in stations) / sum(s.pairs for s in stations)


def size_ratios(stations: Sequence[PairedErrors]) -> list[SizeRatio]:
    """Sizes of position and attitude errors by the second engine over those by the first.

    Args:
        stations: of different distances; errors count in units of each distance's root mean square.
    """
    one, other = (_squares(stations, which) for which in ("one", "other"))
    blocks = list(range(len(one)))
    ends = ratio_intervals(other, one, blocks, "engines, joint errors")
    rows = []
    for column, name in enumerate(("position", "attitude")):
        ratio = float(np.sqrt(other[:, column].sum() / one[:, column].sum()))
        interval = ends[column]
        rows.append(
            SizeRatio(
                name,
                len(one),
                ratio,
                None if interval is None else (float(np.sqrt(interval[0])), float(np.sqrt(interval[1]))),
            )
        )
    return rows


def mean_differences(stations: Sequence[PairedErrors]) -> list[MeanDifference]:
    """Systematic differences of the poses by the two engines' images, by component."""
    scaled = np.concatenate([(s.other - s.one) / _root_mean_square(s) for s in stations])
    count, components = scaled.shape
    # Bonferroni: all components together are inside with 95 %.
    reach = t.ppf(1 - (1 - CONFIDENCE) / 2 / components, count - 1) * scaled.std(axis=0, ddof=1) / np.sqrt(count)
    means = scaled.mean(axis=0)
    return [MeanDifference(name, float(means[i]), float(reach[i])) for i, name in enumerate(COMPONENTS)]


def station_rows(stations: Sequence[PairedErrors]) -> list[dict[str, Any]]:
    """Root mean square errors of each engine at each distance."""
    return [
        {
            "distance_m": s.distance_m,
            "pairs": s.pairs,
            "fixes": len(s.one),
            "first_rms": dict(zip(COMPONENTS, _rms(s.one).tolist(), strict=True)),
            "second_rms": dict(zip(COMPONENTS, _rms(s.other).tolist(), strict=True)),
            "difference_rms": dict(zip(COMPONENTS, _rms(s.other - s.one).tolist(), strict=True)),
        }
        for s in stations
    ]


def navigation_table(stations: Sequence[PairedErrors]) -> dict[str, Any]:
    """All figures, for JSON."""
    return {
        "stations": station_rows(stations),
        "ratios": [asdict(row) for row in size_ratios(stations)],
        "mean_differences": [asdict(row) for row in mean_differences(stations)],
    }


def _squares(stations: Sequence[PairedErrors], which: str) -> Array:
    """(n, 2) squared sizes of position and attitude errors, in units of each distance's own mean square."""
    rows = []
    for station in stations:
        both = [_two_squares(errors) for errors in (station.one, station.other)]
        unit = np.concatenate(both).mean(axis=0)
        rows.append(both[0 if which == "one" else 1] / unit)
    return np.concatenate(rows)


def _two_squares(errors: Array) -> Array:
    return np.stack([np.square(errors[:, :3]).sum(axis=1), np.square(errors[:, 3:]).sum(axis=1)], axis=1)


def _root_mean_square(station: PairedErrors) -> Array:
    return _rms(np.concatenate([station.one, station.other]))


def _rms(errors: Array) -> Array:
    result: Array = np.sqrt(np.mean(np.square(errors), axis=0))
    return result


@dataclass(frozen=True)
class PairedDatasets:
    """Two datasets of the same poses at one distance.

    Attributes:
        distance_m: of the drogue. [m]
        one, other: folders.
    """

    distance_m: float
    one: Path
    other: Path


def station_recipe(engine: str, distance_m: float, pairs: int, seed: int) -> RecipeSource:
    """The recipe of the pairs at one distance.

    Both engines take the same number of samples for every pixel of the drogue: an engine with more samples at the
    markers' edges would have smaller pose errors for that reason alone.
    """
    source = load_recipe(RECIPE, seed)
    side = 2 * round(np.sqrt(_SAMPLES_AT_5_M) * distance_m / 5.0 / 2)
    samples = int(np.clip(side**2, 4, _MOST_SAMPLES))
    changes = {
        "frames": {"count": pairs, "scenes": pairs},
        "distance": {"law": "stations", "stations_m": (distance_m,)},
        "render": {
            **source.recipe.render.model_dump(),
            "engine": engine,
            "samples_per_px": samples,
            "open_samples_per_px": samples,
            "edge_samples_per_px": samples,
        },
    }
    return RecipeSource(Recipe.model_validate({**source.recipe.model_dump(), **changes}), source.text)


def pairs_by_station(stations_m: Sequence[float], pairs: int) -> dict[float, int]:
    """Equal numbers of pairs at each distance; the first distances take the remainder."""
    each, rest = divmod(pairs, len(stations_m))
    return {station_m: each + (place < rest) for place, station_m in enumerate(stations_m) if each + (place < rest)}


def render_paired(
    out: Path, engines: tuple[str, str], station_m: float, pairs: int, seed: int, report: ProgressReport
) -> PairedDatasets:
    """Render the poses of one distance by both engines; existing pairs are kept.

    Raises:
        ValueError: a folder holds something else, an engine cannot be used, or frames could not be rendered.
        OSError: the folder cannot be written.
    """
    folders = []
    for engine in engines:
        source = station_recipe(engine, station_m, pairs, seed)
        folder = out / engine / f"{station_m:g}m"
        report.say(
            f"navigation at {station_m:g} m: {pairs} pairs by {engine}, {source.recipe.render.samples_per_px} samples"
        )
        summary = render_dataset(source, folder, range(pairs), 1, report)
        if summary.drops:
            raise ValueError(f"{folder}: {len(summary.drops)} frames could not be made: {summary.drops[0].reason}")
        folders.append(folder)
    return PairedDatasets(station_m, folders[0], folders[1])


def paired_errors(paired: PairedDatasets) -> PairedErrors:
    """Navigate on both datasets without their truth, and compare with it.

    Raises:
        ValueError: the datasets do not hold the same frames, or cannot be read.
        OSError: the estimates cannot be written beside the datasets.
    """
    datasets = Dataset(paired.one), Dataset(paired.other)
    frames: list[dict[int, str]] = [
        {index: dataset.record(index).frame.model_dump_json() for index in dataset.frame_indices}
        for dataset in datasets
    ]
    if frames[0] != frames[1]:
        raise ValueError(f"{paired.one}, {paired.other}: do not hold the same frames; remove both and render again")
    found = _errors(datasets[0], paired.one), _errors(datasets[1], paired.other)
    common = sorted(found[0].keys() & found[1].keys())
    one, other = (np.array([errors[i] for i in common]).reshape(-1, len(COMPONENTS)) for errors in found)
    return PairedErrors(paired.distance_m, len(datasets[0].frame_indices), one, other)


def _errors(dataset: Dataset, folder: Path) -> dict[int, Array]:
    """(5,) errors by frame, for frames with a pose."""
    estimates = list(navigate(BlindDataset(folder), (METHOD,)))
    write_estimates(folder.parent / f"{folder.name}.jsonl", estimates)
    errors = {}
    for estimate in estimates:
        truth = dataset.record(estimate.frame_index).left_from_drogue
        if isinstance(estimate, PoseEstimate) and truth is not None:
            errors[estimate.frame_index] = pose_error(estimate.left_from_drogue, truth).components
    return errors
