"""How far each estimated pose is from the true one, and the estimates of a file sorted by method."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from geometry.se3 import Array, RigidTransform, angles_from_axis

COMPONENTS = ("x", "y", "z", "pitch", "yaw")
"""Order of errors and bounds: X, Y, Z in the left camera [m], then pitch and yaw [deg]."""

# Larger than anything that flies, and its square far from overflow.
_MOST = 1e9


@dataclass(frozen=True, eq=False)
class PoseError:
    """Estimate minus truth, for one pair.

    Attributes:
        components: (5,) X, Y, Z in the left camera [m], pitch and yaw of the axis [deg].
        transverse_m: length of the part across the line of sight to the true rim centre. [m]
    """

    components: Array
    transverse_m: float

    @property
    def position_m(self) -> float:
        """Length of the position error. [m]"""
        return float(np.linalg.norm(self.components[:3]))


def pose_error(estimate: RigidTransform, truth: RigidTransform) -> PoseError:
    """Error of a pose; roll does not count, for equal markers leave it open.

    Angles are compared as pitch and yaw of the axis, each difference in (-180, 180]. [deg]
    """
    offset = estimate.translation_m - truth.translation_m
    sight = truth.translation_m / np.linalg.norm(truth.translation_m)
    across = offset - (offset @ sight) * sight
    pitch, yaw = angles_from_axis(np.stack([estimate.rotation[:, 2], truth.rotation[:, 2]]))
    turns = np.rad2deg([pitch[0] - pitch[1], yaw[0] - yaw[1]])
    wrapped = 180.0 - np.mod(180.0 - turns, 360.0)
    return PoseError(np.concatenate([offset, wrapped]), float(np.linalg.norm(across)))


def by_method(
    estimates: Iterable[Estimate], frame_indices: Iterable[int], source: str
) -> dict[str, dict[int, Estimate]]:
    """Estimates by method and frame, methods in the order of the file.

    Args:
        estimates: all of a file.
        frame_indices: the dataset's pairs.
        source: what to call the file in errors.

    Raises:
        ValueError: no estimates at all, one for a pair that the dataset lacks, two of a method for the same pair, or a
            number that is no measure of anything here, and whose square no float can hold.
    """
    known = set(frame_indices)
    methods: dict[str, dict[int, Estimate]] = {}
    for estimate in estimates:
        index, method = estimate.frame_index, estimate.method
        if index not in known:
            raise ValueError(f"{source}: method {method!r}: frame {index} is not in the dataset")
        frames = methods.setdefault(method, {})
        if index in frames:
            raise ValueError(f"{source}: method {method!r}: frame {index} occurs twice")
        largest = _largest_number(estimate)
        if largest > _MOST:
            raise ValueError(
                f"{source}: method {method!r}: frame {index}: lengths, speeds and times must be at most {_MOST:g} "
                f"in SI units, got {largest:g}"
            )
        frames[index] = estimate
    if not methods:
        raise ValueError(f"{source}: holds no estimates; run an estimator on this dataset first")
    return methods


def _largest_number(estimate: Estimate) -> float:
    """The largest length, speed or time of an estimate. [m, m/s, rad/s, s]"""
    numbers = [estimate.latency_s or 0.0, *estimate.stage_s.values()]
    if isinstance(estimate, PoseEstimate):
        numbers += estimate.left_from_drogue.translation_m.tolist()
        if estimate.motion is not None:
            numbers += [*estimate.motion.velocity_m_s, *estimate.motion.rate_rad_s]
        if estimate.docking is not None:
            told = estimate.docking
            numbers += [*told.mouth_from_tip_m, *told.mouth_sd_m]
            numbers += [told.closure_m_s or 0.0, told.miss_m or 0.0, told.miss_sd_m or 0.0, told.contact_s or 0.0]
            numbers.append(told.capture_radius_m or 0.0)
    return max(abs(number) for number in numbers)
