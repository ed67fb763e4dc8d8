"""The measurement of one stereo pair, and the estimate that a pose method makes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Estimate, Feature, Mode, NoFix, PoseEstimate, Region
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from nav.detector.detector import StereoDetection
from nav.lens_correction import distort_observation
from nav.matching.marker_channel import PLAIN
from nav.pose.method_registry import pose_method
from nav.pose.pose_method import OUTER_EDGE, NoFixReason, Observation, Solution
from nav.refinement import rough_pose


@dataclass(frozen=True, eq=False)
class PairMeasurement:
    """The markers measured in one pair.

    Attributes:
        observation: the matched markers, or why there are none.
        stage_s: seconds by stage. [s]
        others_weight: weight of the other colours in the channel, see `nav.matching.marker_channel`.
        blind_eye: why one eye shows no markers, where only the other one does.
        regions: where the markers were searched.
        rough: the pose from the binary centroids, None until `with_rough` computes it.
    """

    observation: Observation | NoFixReason
    stage_s: dict[str, float]
    others_weight: float = PLAIN
    blind_eye: str = ""
    regions: tuple[Region, ...] = ()
    rough: Solution | NoFixReason | None = None

    @property
    def markers(self) -> tuple[int, int]:
        """Number of markers measured in both eyes, and number of all measurements."""
        seen = self.observation
        return (0, 0) if isinstance(seen, NoFixReason) else (int(seen.paired.sum()), int(seen.seen.sum()))

    def with_rough(self) -> PairMeasurement:
        """This measurement with the rough pose, computed at most once."""
        if self.rough is not None:
            return self
        start = perf_counter()
        seen = self.observation
        rough = seen if isinstance(seen, NoFixReason) else rough_pose(seen)
        return replace(self, rough=rough, stage_s={**self.stage_s, "rough": perf_counter() - start})


def regions_of(found: StereoDetection, source: str) -> tuple[Region, ...]:
    """Boxes as regions, with the name of their source."""
    found_by_eye = ((eye, found.of(eye)) for eye in EYES)
    return tuple(
        Region(eye=eye, box_xywh_px=one.box_xywh_px, source=source, score=min(1.0, max(0.0, one.score)))
        for eye, one in found_by_eye
        if one is not None
    )


def estimate_pose(frame_index: int, measurement: PairMeasurement, method: str) -> Estimate:
    """Estimate the pose from a measurement by one method.

    Raises:
        ValueError: a method that does not exist.
    """
    solve = pose_method(method)
    observation = measurement.observation
    if isinstance(observation, NoFixReason):
        return NoFix(
            frame_index=frame_index,
            method=method,
            reason=observation.reason,
            stage_s=measurement.stage_s,
            regions=measurement.regions,
        )
    start = perf_counter()
    solution = solve(observation)
    stage_s = {**measurement.stage_s, "pose": perf_counter() - start}
    if isinstance(solution, NoFixReason):
        return NoFix(
            frame_index=frame_index,
            method=method,
            reason=f"{solution.reason}: {measurement.blind_eye}" if measurement.blind_eye else solution.reason,
            features=_features(observation, np.zeros_like(observation.seen), None),
            stage_s=stage_s,
            regions=measurement.regions,
        )
    return PoseEstimate(
        frame_index=frame_index,
        method=method,
        left_from_drogue=solution.left_from_drogue,
        covariance=solution.covariance,
        modes=tuple(Mode(left_from_drogue=mode.left_from_drogue, weight=mode.weight) for mode in solution.modes),
        features=_features(observation, solution.used, solution.used_hub),
        stage_s=stage_s,
        regions=measurement.regions,
        note=solution.note,
    )


def _features(
    observation: Observation, used: NDArray[np.bool_], used_hub: NDArray[np.bool_] | None
) -> tuple[Feature, ...]:
    """Per eye the markers and then the hub's outer edge, at their places in the delivered images."""
    features = []
    seen = distort_observation(observation)
    for eye in range(len(EYES)):
        for index in np.flatnonzero(observation.seen[eye]):
            measured = seen.pixels_px[eye, index], seen.cov_px2[eye, index]
            features.append(_feature(EYES[eye], int(index), measured, bool(used[eye, index])))
        if observation.hub_seen[eye, OUTER_EDGE]:
            measured = seen.hub_px[eye, OUTER_EDGE], seen.hub_cov_px2[eye, OUTER_EDGE]
            hub_used = used_hub is not None and bool(used_hub[eye, OUTER_EDGE])
            features.append(_feature(EYES[eye], "hub", measured, hub_used))
    return tuple(features)


def _feature(eye: Eye, index: int | Literal["hub"], measured: tuple[Array, Array], used: bool) -> Feature:
    (x, y), ((a, b), (c, d)) = measured[0].tolist(), measured[1].tolist()
    return Feature(eye=eye, index=index, center_px=(x, y), cov_px2=((a, b), (c, d)), used=used)
