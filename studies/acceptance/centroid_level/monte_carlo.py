"""Accuracy at the level of centroids: drawn poses, exact centres, noise, and what a method makes of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.stats import norm

from datasets_manifest.random_streams import seeded_generator
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.presets import load_drogue
from droguekit.benchmark.poses.bounds import feature_points
from droguekit.benchmark.poses.closed_forms import FacingRing
from droguekit.numerical_threads import one_thread
from geometry.se3 import Array
from geometry.stereo import paper_rig
from nav.pose.stated_tolerances import EXACT, StatedTolerances
from studies.acceptance.centroid_level.batch_scores import (
    bound_deviations,
    flipped,
    pose_errors,
    sight_tilts,
    squared_errors,
)
from studies.acceptance.centroid_level.corruption import CLEAN, Corruption, draw_shifts
from studies.acceptance.centroid_level.drawn_poses import Poses, draw_poses, ellipse_centers_px
from studies.acceptance.centroid_level.solvers import Measured, Solved, solve
from studies.acceptance.centroid_level.tolerances import AS_BUILT, Tolerances, draw_features

# Noise of an evenly lit hub's centre over that of a marker's: between 1.3 and 1.5 on rendered frames.
HUB_NOISE_FACTOR = 1.5
# Enough for a variance good to 16 %, which shifts a 95 % limit by little.
BLOCKS = 40
# Above so many deviations of the flip law a tilt has a sign.
CLEAR_TILT_SCALES = 3.0


@dataclass(frozen=True)
class Cell:
    """One set of draws and the method that is tried on it.

    Attributes:
        method: its name.
        markers: 5, 7 or 8: which shipped drogue.
        distance_m: nearest and farthest. [m]
        sigma_px: noise of the markers' centres.
        draws: how many frames.
        corruption, tolerances: what is wrong with centroids, drogue and cameras.
        stated: tolerances as the method is told.
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


class DepthRival(BaseModel):
    """Another way to the depth, on the same draws.

    Attributes:
        z_rms_m: of its errors. [m]
        correlation: of its errors with those of the cell's method, about zero.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    z_rms_m: float
    correlation: float


class CellResult(BaseModel):
    """What came out of a cell.

    Attributes:
        n, fixes: frames, and those with a pose.
        position_sums_m: lengths of the position errors, summed over consecutive blocks of draws. [m]
        z_rms_m: [m]
        nrms: root mean square of X, Y, Z, pitch and yaw errors, each over the bound of its frame.
        clear_n, clear_nrms: the same of pitch and yaw where the true tilt is clear of the flip law.
        nees_n, nees: frames with a covariance, and mean normalised square error over its five degrees of freedom.
        flips, flip_law: mirrored tilts, and their share by the law.
        stereo: the mean of the triangulated markers.
        untold: the same method, told of no tolerances; None where it was told of none anyway.

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
    stereo: DepthRival
    untold: DepthRival | None

    @property
    def position_mean_m(self) -> float:
        """Mean position error. [m]"""
        return sum(self.position_sums_m) / self.n


def run_cell(cell: Cell) -> CellResult:
    """Draw, measure, solve and score one cell, the same to the last bit every time.

    Raises:
        ValueError: a method that does not exist, or a distance at which the drogue is not in view.
    """
    with one_thread():
        return _result(cell)


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
        untold = _rival(plain.poses.translations_m[:, 2] - depth, errors[:, 2])
    return CellResult(
        n=cell.draws,
        fixes=int(solved.fixed.sum()),
        position_sums_m=tuple(float(part.sum()) for part in np.array_split(position, min(BLOCKS, cell.draws))),
        z_rms_m=_rms(errors[:, 2]),
        nrms=(_rms(ratios[:, 0]), _rms(ratios[:, 1]), _rms(ratios[:, 2]), _rms(ratios[:, 3]), _rms(ratios[:, 4])),
        clear_n=int(clear.sum()),
        clear_nrms=(_rms(ratios[clear, 3]), _rms(ratios[clear, 4])) if clear.any() else None,
        nees_n=len(squares),
        nees=float(squares.mean()) / 5 if len(squares) else None,
        flips=int(mirrored.sum()),
        flip_law=float(norm.sf(sizes).mean()),
        stereo=_rival(np.nan_to_num(stereo_m, nan=0.0) - depth, errors[:, 2]),
        untold=untold,
    )


def _measure(cell: Cell, layout: MarkerLayout, poses: Poses) -> Measured:
    key = f"{cell.stream}, {cell.markers} markers, {cell.sigma_px:g} px, {cell.corruption}, {cell.tolerances}"
    true = draw_features(seeded_generator(cell.seed, key, "features"), layout, cell.tolerances, cell.draws)
    _, radii = feature_points(layout)
    exact = ellipse_centers_px(paper_rig(), poses, true.centers_m, radii, true.right)
    # The same noise with and without bad markers, so that their effect stands out.
    noise_key = f"{cell.stream}, {cell.markers} markers, {cell.sigma_px:g} px"
    noise = seeded_generator(cell.seed, noise_key, "noise").standard_normal(exact.shape)
    hub_sigma_px = HUB_NOISE_FACTOR * cell.sigma_px
    count = layout.count
    shifts = draw_shifts(seeded_generator(cell.seed, key, "shifts"), cell.corruption, cell.draws, count)
    return Measured(
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


def _rival(others: Array, own: Array) -> DepthRival:
    z_rms_m = _rms(others)
    return DepthRival(z_rms_m=z_rms_m, correlation=float(np.mean(others * own)) / (z_rms_m * _rms(own)))


def _squares(solved: Solved, errors: Array) -> Array:
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


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
