"""One stereo pair through detector, centroids and correspondence, then through every method on the same markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.estimates import Estimate, Feature, Mode, NoFix, PoseEstimate
from datasets_manifest.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, StereoRig
from nav.centroids.binary_chain import Centroids, binary_centroids
from nav.channels import marker_channel, marker_color
from nav.correspondence import correspond
from nav.detector.color_blob import ColorBlobDetector
from nav.detector.interface import Detector
from nav.pose.interface import NoFixReason, Observation
from nav.pose.registry import pose_method


@dataclass(frozen=True, eq=False)
class Sighting:
    """What was measured in one pair.

    Attributes:
        observation: the matched markers, or why there are none.
        stage_s: seconds by stage. [s]
    """

    observation: Observation | NoFixReason
    stage_s: dict[str, float]


class Navigator:
    """Finds one known drogue with one rig."""

    def __init__(self, rig: StereoRig, drogue: DrogueParameters, detector: Detector | None = None) -> None:
        self._rig = rig
        self._layout = marker_layout(drogue)
        self._color = marker_color(drogue)
        self._detector: Detector = ColorBlobDetector(drogue) if detector is None else detector

    def observe(self, images: StereoImages) -> Sighting:
        """Measure the markers of one pair and match them."""
        size_px = (self._rig.camera.width_px, self._rig.camera.height_px)
        if images.size_px != size_px:
            got, want = ("x".join(map(str, size)) for size in (images.size_px, size_px))
            return Sighting(NoFixReason(f"the images are {got} px, the rig's {want} px"), {})
        start = perf_counter()
        detection = self._detector.detect(images)
        detected = perf_counter()
        stage_s = {"detect": detected - start}
        centroids: list[Centroids] = []
        for eye in EYES:
            found = detection.of(eye)
            if found is None:
                return Sighting(NoFixReason(f"no drogue detected in the {eye} image"), stage_s)
            channel = marker_channel(images, eye, self._color)
            centroids.append(binary_centroids(channel, found.box_xywh_px, self._layout))
        measured = perf_counter()
        observation = correspond(centroids[0], centroids[1], self._rig, self._layout)
        stage_s |= {"centroids": measured - detected, "correspond": perf_counter() - measured}
        return Sighting(observation, stage_s)

    def estimate(self, frame_index: int, images: StereoImages, methods: Sequence[str]) -> list[Estimate]:
        """Answers of every method on the same measurements, in the order of `methods`.

        Raises:
            ValueError: a method that does not exist.
        """
        sighting = self.observe(images)
        return [estimate_pose(frame_index, sighting, method) for method in methods]


def estimate_pose(frame_index: int, sighting: Sighting, method: str) -> Estimate:
    """One method's answer to what was measured.

    Raises:
        ValueError: a method that does not exist.
    """
    solve = pose_method(method)
    observation = sighting.observation
    if isinstance(observation, NoFixReason):
        return NoFix(frame_index=frame_index, method=method, reason=observation.reason, stage_s=sighting.stage_s)
    start = perf_counter()
    solution = solve(observation)
    stage_s = {**sighting.stage_s, "pose": perf_counter() - start}
    if isinstance(solution, NoFixReason):
        features = _features(observation, np.zeros_like(observation.seen))
        return NoFix(frame_index=frame_index, method=method, reason=solution.reason, features=features, stage_s=stage_s)
    return PoseEstimate(
        frame_index=frame_index,
        method=method,
        left_from_drogue=solution.left_from_drogue,
        covariance=solution.covariance,
        modes=tuple(Mode(left_from_drogue=mode.left_from_drogue, weight=mode.weight) for mode in solution.modes),
        features=_features(observation, solution.used),
        stage_s=stage_s,
    )


def _features(observation: Observation, used: NDArray[np.bool_]) -> tuple[Feature, ...]:
    features = []
    for eye, pixels, covariances, mask in zip(EYES, observation.pixels_px, observation.cov_px2, used, strict=True):
        for index in np.flatnonzero(np.isfinite(pixels).all(axis=1)):
            (a, b), (c, d) = covariances[index].tolist()
            x, y = pixels[index].tolist()
            features.append(
                Feature(eye=eye, index=int(index), center_px=(x, y), cov_px2=((a, b), (c, d)), used=bool(mask[index]))
            )
    return tuple(features)
