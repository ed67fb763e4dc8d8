"""Monte-Carlo accuracy at the level of centroids: drawn poses, exact centres plus noise, and a method's errors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict
from scipy.stats import norm

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.random_streams import seeded_generator
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.presets import load_drogue
from droguekit.batch.progress import ProgressReport
from droguekit.numerical_threads import one_thread
from droguekit.scoring.confidence_intervals import root_mean_square
from droguekit.scoring.poses.cramer_rao import FacingRing, feature_points
from geometry.se3 import Array, angles_from_axis, skew
from geometry.stereo import StereoRig, paper_rig
from nav.pose.pose_method import EXACT, StatedTolerances
from studies.acceptance.centroid_level.drawn_frames import (
    AS_BUILT,
    CLEAN,
    Corruption,
    Poses,
    Tolerances,
    draw_features,
    draw_poses,
    draw_shifts,
    ellipse_centers_px,
)
from studies.acceptance.centroid_level.solvers import MeasuredFrames, SolvedFrames, solve
from studies.acceptance.finished_results import results_fingerprint

# Central differences: their error goes with the square of the step, that of rounding with its inverse; both stay near
# 1e-8 of the derivative for steps of this size. [m and rad]
_STEP = 1e-5
# Noise of an evenly lit hub's centre over that of a marker's: between 1.3 and 1.5 on rendered frames.
HUB_NOISE_FACTOR = 1.5
# Enough for a variance within 16 %, which hardly changes a 95 % limit.
BLOCKS = 40
CELLS_FILE = "cells.json"
# A tilt above this many standard deviations of the flip law is clear.
CLEAR_TILT_SCALES = 3.0
STATIONS_M = (1.7, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
SIGMAS_PX = (0.05, 0.1, 0.2, 0.35)
MARKER_COUNTS = (5, 7, 8)
# Corrupted markers are tried over the whole of this range, not at stations.
DOCKING_RANGE_M = (1.7, 10.0)
# Draws of a cell for methods that are solved in batches, and for those that are not.
BATCHED_DRAWS = 10_000
SINGLE_DRAWS = 1000
# The binomial error of a rate is then at most 0.0025: the worst of 108 cells can still be told from 0.02.
FLIP_DRAWS = 40_000
# The order of 5, 7 and 8 markers differs by at least two percent in the mean, which needs this many draws.
ORDER_DRAWS = 48_000
# By at least ten percent for the robust method, which takes longer.
ROBUST_ORDER_DRAWS = 2000


@dataclass(frozen=True)
class Cell:
    """One set of draws and the method that is tried on it.

    Attributes:
        method: its name.
        markers: 5, 7 or 8: which shipped drogue.
        distance_m: nearest and farthest. [m]
        sigma_px: noise of the markers' centres.
        draws: how many frames.
        corruption, tolerances: errors of centroids, drogue and cameras.
        stated: tolerances that the method knows.
        seed: of the draws.
    """

    method: str
    markers: int
    distance_m: tuple[float, float]
    sigma_px: float
    draws: int
    seed: int
    corruption: Corruption = CLEAN
    tolerances: Tolerances = field(default=AS_BUILT)
    stated: StatedTolerances = EXACT

    @property
    def stream(self) -> str:
        """Key of the draws: cells that differ in method or number of markers see the same poses."""
        return f"{self.distance_m[0]:g}-{self.distance_m[1]:g} m, {self.draws} draws"


class DepthAlternative(BaseModel):
    """Another depth estimate on the same draws.

    Attributes:
        z_rms_m: of its errors. [m]
        correlation: of its errors with those of the cell's method, about zero.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    z_rms_m: float
    correlation: float


class CellResult(BaseModel):
    """Scores of a cell.

    Attributes:
        n, fixes: frames, and those with a pose.
        position_sums_m: lengths of the position errors, summed over consecutive blocks of draws. [m]
        z_rms_m: [m]
        nrms: root mean square of X, Y, Z, pitch and yaw errors, each over the bound of its frame.
        clear_n, clear_nrms: the same of pitch and yaw where the true tilt is clear of the flip law.
        nees_n, nees: frames with a covariance, and mean normalised square error over its five degrees of freedom.
        flips, flip_law: mirrored tilts, and their share by the law.
        stereo: the mean of the triangulated markers.
        untold: the same method without stated tolerances; None where none were stated anyway.

    A frame without a pose counts with the standard deviation of the drawn poses.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    n: int
    fixes: int
    position_sums_m: tuple[float, ...]
    z_rms_m: float
    nrms: tuple[float, float, float, float, float]
    clear_n: int
    clear_nrms: tuple[float, float] | None
    nees_n: int
    nees: float | None
    flips: int
    flip_law: float
    stereo: DepthAlternative
    untold: DepthAlternative | None

    @property
    def position_mean_m(self) -> float:
        """Mean position error. [m]"""
        return sum(self.position_sums_m) / self.n


def run_cells(cells: Sequence[Cell], out: Path, report: ProgressReport) -> dict[Cell, CellResult]:
    """Results of all cells; those in `out` that the same code made are used again.

    Raises:
        ValueError: a cell that cannot be run, or `cells.json` is not ours.
        OSError: the folder cannot be written.
    """
    path, code = out / CELLS_FILE, results_fingerprint()
    known = _read(path, code, report)
    wanted = list(dict.fromkeys(cells))
    todo = [cell for cell in wanted if repr(cell) not in known]
    if len(todo) < len(wanted):
        report.say(f"{len(wanted) - len(todo)} of {len(wanted)} cells are finished already")
    report.begin("cells", len(todo))
    try:
        for cell in todo:
            known[repr(cell)] = run_cell(cell)
            table = {"code": code, "cells": {key: value.model_dump() for key, value in known.items()}}
            write_text_atomic(path, json.dumps(table, indent=1, allow_nan=False) + "\n")
            report.advance()
    finally:
        report.end()
    return {cell: known[repr(cell)] for cell in wanted}


def run_cell(cell: Cell) -> CellResult:
    """Draw, measure, solve and score one cell, reproducible to the last bit.

    Raises:
        ValueError: a method that does not exist, or a distance at which the drogue is not in view.
    """
    with one_thread():
        return _result(cell)


def pose_errors(estimates: Poses, truth: Poses) -> Array:
    """(n, 5) X, Y, Z [m], pitch and yaw [deg], estimate minus truth."""
    found, true = (np.stack(angles_from_axis(poses.rotations[:, :, 2]), axis=-1) for poses in (estimates, truth))
    turns = np.rad2deg((found - true + np.pi) % (2 * np.pi) - np.pi)
    return np.concatenate([estimates.translations_m - truth.translations_m, turns], axis=1)


def component_slopes(rotations: Array) -> Array:
    """(n, 5, 6) derivatives of X, Y, Z [m], pitch and yaw [deg] by the tangent of estimates."""
    axes = rotations[:, :, 2]
    x, y, z = axes.T
    across2 = x**2 + z**2
    across = np.sqrt(across2)
    by_axis = np.zeros((len(axes), 2, 3))
    by_axis[:, 0] = np.stack([x * y / across, -across, z * y / across], axis=-1)
    by_axis[:, 1] = np.stack([z, np.zeros_like(z), -x], axis=-1) / across2[:, None]
    slopes = np.zeros((len(axes), 5, 6))
    slopes[:, :3, :3] = np.eye(3)
    slopes[:, 3:, 3:] = np.rad2deg(-by_axis @ skew(axes))
    return slopes


def bound_deviations(rig: StereoRig, truth: Poses, centers_m: Array, radii_m: Array, noise_px: Array) -> Array:
    """Cramer-Rao bound of many poses whose features both eyes see.

    Args:
        rig: the cameras.
        truth: n poses.
        centers_m, radii_m: (F, 3) and (F,) of the features.
        noise_px: (F,) standard deviation of each coordinate of a centre.

    Returns:
        (n, 5) standard deviations of X, Y, Z [m], pitch and yaw [deg].
    """
    count = len(truth.rotations)
    slopes = np.empty((count, 2, len(radii_m), 2, 6))
    for k in range(6):
        ends = []
        for sign in (1, -1):
            step = np.zeros(6)
            step[k] = sign * _STEP
            turned = (np.eye(3) + skew(step[3:]) + skew(step[3:]) @ skew(step[3:]) / 2) @ truth.rotations
            ends.append(ellipse_centers_px(rig, Poses(turned, truth.translations_m + step[:3]), centers_m, radii_m))
        slopes[..., k] = (ends[0] - ends[1]) / (2 * _STEP)
    rows = (slopes / noise_px[:, None, None]).reshape(count, -1, 6)
    covariance = np.linalg.inv(np.swapaxes(rows, 1, 2) @ rows)
    components = component_slopes(truth.rotations)
    scored = components @ covariance @ np.swapaxes(components, 1, 2)
    deviations: Array = np.sqrt(np.diagonal(scored, axis1=1, axis2=2))
    return deviations


def squared_errors(estimates: Poses, covariances: Array, errors: Array) -> Array:
    """(n,) normalised squares of the five errors, of mean 5 where covariances (n, 6, 6) are true."""
    slopes = component_slopes(estimates.rotations)
    covariance = slopes @ covariances @ np.swapaxes(slopes, 1, 2)
    squares: Array = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
    return squares


def sight_tilts(rig: StereoRig, poses: Poses, truth: Poses) -> Array:
    """(n, 2) tilt of the poses' axes about the line of sight to the true place, between the eyes. [rad]"""
    sight = truth.translations_m - np.array([rig.baseline_m / 2, 0.0, 0.0])
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    across = np.cross(np.broadcast_to([0.0, 1.0, 0.0], sight.shape), sight)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(sight, across)
    axis = poses.rotations[:, :, 2]
    parts = np.stack([np.einsum("ni,ni->n", axis, across), np.einsum("ni,ni->n", axis, up)], axis=-1)
    size = np.linalg.norm(parts, axis=1)
    angle = np.arctan2(size, np.einsum("ni,ni->n", axis, sight))
    tilts: Array = parts * (angle / np.maximum(size, np.finfo(np.float64).tiny))[:, None]
    return tilts


def flipped(tilts: Array, true_tilts: Array) -> NDArray[np.bool_]:
    """(n,) whether the tilt points away from the true one."""
    mirrored: NDArray[np.bool_] = np.einsum("ni,ni->n", tilts, true_tilts) < 0
    return mirrored


def _result(cell: Cell) -> CellResult:
    rig, drogue = paper_rig(), load_drogue(f"red-{cell.markers}")
    layout = marker_layout(drogue)
    poses = draw_poses(
        seeded_generator(cell.seed, cell.stream, "poses"), rig, drogue.rim_radius_m, cell.distance_m, cell.draws
    )
    measured = _measure(cell, layout, poses)
    solved = solve(cell.method, measured)
    errors = np.where(solved.fixed[:, None], pose_errors(solved.poses, poses), _prior(poses))
    centers, radii = feature_points(layout)
    noise = np.append(np.full(layout.count, cell.sigma_px), HUB_NOISE_FACTOR * cell.sigma_px)
    used = slice(None) if cell.method == "joint-hub" else slice(layout.count)
    ratios = errors / bound_deviations(rig, poses, centers[used], radii[used], noise[used])
    tilts, scales = sight_tilts(rig, poses, poses), _tilt_scales(layout, cell, poses)
    sizes = np.linalg.norm(tilts, axis=1) / scales
    clear = sizes > CLEAR_TILT_SCALES
    mirrored = flipped(sight_tilts(rig, solved.best, poses), tilts) & solved.fixed
    squares = _squares(solved, errors)
    position = np.linalg.norm(errors[:, :3], axis=1)
    depth = poses.translations_m[:, 2]
    stereo_m = rig.triangulate(measured.markers_px[:, 0], measured.markers_px[:, 1])[..., 2].mean(axis=1)
    untold = None
    if cell.stated != EXACT:
        plain = solve(cell.method, replace(measured, tolerances=EXACT))
        untold = _alternative(plain.poses.translations_m[:, 2] - depth, errors[:, 2])
    return CellResult(
        n=cell.draws,
        fixes=int(solved.fixed.sum()),
        position_sums_m=tuple(float(part.sum()) for part in np.array_split(position, min(BLOCKS, cell.draws))),
        z_rms_m=root_mean_square(errors[:, 2]),
        nrms=(
            root_mean_square(ratios[:, 0]),
            root_mean_square(ratios[:, 1]),
            root_mean_square(ratios[:, 2]),
            root_mean_square(ratios[:, 3]),
            root_mean_square(ratios[:, 4]),
        ),
        clear_n=int(clear.sum()),
        clear_nrms=(root_mean_square(ratios[clear, 3]), root_mean_square(ratios[clear, 4])) if clear.any() else None,
        nees_n=len(squares),
        nees=float(squares.mean()) / 5 if len(squares) else None,
        flips=int(mirrored.sum()),
        flip_law=float(norm.sf(sizes).mean()),
        stereo=_alternative(np.nan_to_num(stereo_m, nan=0.0) - depth, errors[:, 2]),
        untold=untold,
    )


def _measure(cell: Cell, layout: MarkerLayout, poses: Poses) -> MeasuredFrames:
    key = f"{cell.stream}, {cell.markers} markers, {cell.sigma_px:g} px, {cell.corruption}, {cell.tolerances}"
    true = draw_features(seeded_generator(cell.seed, key, "features"), layout, cell.tolerances, cell.draws)
    _, radii = feature_points(layout)
    exact = ellipse_centers_px(paper_rig(), poses, true.centers_m, radii, true.right)
    # The same noise with and without bad markers, so that only their effect differs.
    noise_key = f"{cell.stream}, {cell.markers} markers, {cell.sigma_px:g} px"
    noise = seeded_generator(cell.seed, noise_key, "noise").standard_normal(exact.shape)
    hub_sigma_px = HUB_NOISE_FACTOR * cell.sigma_px
    count = layout.count
    shifts = draw_shifts(seeded_generator(cell.seed, key, "shifts"), cell.corruption, cell.draws, count)
    return MeasuredFrames(
        rig=paper_rig(),
        layout=layout,
        markers_px=exact[:, :, :count] + cell.sigma_px * noise[:, :, :count] + shifts,
        hub_px=exact[:, :, count] + hub_sigma_px * noise[:, :, count] if cell.method == "joint-hub" else None,
        sigma_px=cell.sigma_px,
        hub_sigma_px=hub_sigma_px,
        tolerances=cell.stated,
    )


def _tilt_scales(layout: MarkerLayout, cell: Cell, poses: Poses) -> Array:
    """(n,) scale of the flip law, at the distance along the line of sight, about which a tilt is mirrored. [rad]"""
    rig, radius_m = paper_rig(), layout.ring_radius_m
    assert radius_m is not None
    one = FacingRing(rig.camera.fx_px, rig.baseline_m, radius_m, layout.count, 1.0).tilt_rad
    sight = poses.translations_m - np.array([rig.baseline_m / 2, 0.0, 0.0])
    scales: Array = cell.sigma_px * one * (sight**2).sum(axis=1)
    return scales


def _alternative(others: Array, own: Array) -> DepthAlternative:
    z_rms_m = root_mean_square(others)
    return DepthAlternative(
        z_rms_m=z_rms_m, correlation=float(np.mean(others * own)) / (z_rms_m * root_mean_square(own))
    )


def _squares(solved: SolvedFrames, errors: Array) -> Array:
    if solved.covariances is None:
        return np.zeros(0)
    chosen = solved.fixed
    poses = Poses(solved.poses.rotations[chosen], solved.poses.translations_m[chosen])
    return squared_errors(poses, solved.covariances[chosen], errors[chosen])


def _prior(poses: Poses) -> Array:
    """(5,) standard deviations of the drawn X, Y, Z [m], pitch and yaw [deg]."""
    level = Poses(np.broadcast_to(np.eye(3), poses.rotations.shape), np.zeros_like(poses.translations_m))
    spread: Array = pose_errors(poses, level).std(axis=0)
    return spread


def _read(path: Path, code: str, report: ProgressReport) -> dict[str, CellResult]:
    if not path.exists():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        made_by, cells = str(table["code"]), dict(table["cells"].items())
        if made_by == code:
            return {key: CellResult.model_validate(value) for key, value in cells.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: does not hold cells of this command; move it away or choose another --out"
        ) from error
    report.say(f"{path} was made by other code: its cells are made again")
    return {}
