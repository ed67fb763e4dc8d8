"""One stereo pair through detector, centroids and correspondence, then through every method.

Methods that belong to the paper's chain work on its binary centroids, the others on edge-fitted ones; every method can
be given either, so that estimators are compared on equal measurements too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.estimates import Estimate, Feature, Mode, NoFix, PoseEstimate
from datasets_manifest.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig
from nav.centroids.binary_chain import NOTHING, Centroids, binary_centroids
from nav.channels import OTHERS_WEIGHTS, PLAIN, marker_channel, marker_color
from nav.correspondence import correspond, no_ring
from nav.detector.color_blob import ColorBlobDetector
from nav.detector.interface import Detector
from nav.pose.interface import OUTER_EDGE, NoFixReason, Observation
from nav.pose.registry import pose_method
from nav.pose.tolerances import EXACT, StatedTolerances
from nav.real_eyes import ideal_centroids, real_observation_px
from nav.refinement import refine

Box = tuple[float, float, float, float]
CentroidChoice = Literal["own", "binary", "edge"]
CENTROID_CHOICES: tuple[CentroidChoice, ...] = ("own", "binary", "edge")
# What the paper and the methods that it compares itself with measure on.
BINARY_METHODS = frozenset(
    {"paper", "paper-literal", "circle-fit", "mono-circle", "mean-plane", "disparity-plane", "constant"}
)


@dataclass(frozen=True, eq=False)
class Sighting:
    """What was measured in one pair.

    Attributes:
        observation: the matched markers, or why there are none.
        stage_s: seconds by stage. [s]
        others_weight: of the channel that it was measured in, see `nav.channels`.
        blind_eye: why one eye shows nothing, where only the other one does.
    """

    observation: Observation | NoFixReason
    stage_s: dict[str, float]
    others_weight: float = PLAIN
    blind_eye: str = ""


class Navigator:
    """Finds one known drogue with one rig."""

    def __init__(
        self,
        rig: StereoRig,
        drogue: DrogueParameters,
        detector: Detector | None = None,
        centroids: CentroidChoice = "own",
        tolerances: StatedTolerances = EXACT,
    ) -> None:
        self._centroids = centroids
        self._tolerances = tolerances
        self._rig = rig
        self._layout = marker_layout(drogue)
        self._color = marker_color(drogue)
        self._detector: Detector = ColorBlobDetector(drogue) if detector is None else detector

    def observe(self, images: StereoImages) -> Sighting:
        """Measure the markers of one pair by the binary chain and match them."""
        size_px = (self._rig.camera.width_px, self._rig.camera.height_px)
        if images.size_px != size_px:
            got, want = ("x".join(map(str, size)) for size in (images.size_px, size_px))
            return Sighting(NoFixReason(f"the images are {got} px, the rig's {want} px"), {})
        start = perf_counter()
        detection = self._detector.detect(images)
        detected = perf_counter()
        stage_s = {"detect": detected - start}
        boxes: dict[Eye, Box] = {}
        for eye in EYES:
            found = detection.of(eye)
            if found is not None:
                boxes[eye] = found.box_xywh_px
        if not boxes:
            return Sighting(NoFixReason("no drogue detected in the left image, nor in the right one"), stage_s)
        best = self._matched(images, boxes, PLAIN)
        for weight in OTHERS_WEIGHTS[1:]:
            if _seen(best)[0] == self._layout.count:
                break
            best = max(best, self._matched(images, boxes, weight), key=_seen)
        return replace(best, stage_s={**stage_s, **best.stage_s})

    def _matched(self, images: StereoImages, boxes: dict[Eye, Box], others_weight: float) -> Sighting:
        """Binary centroids within the boxes, matched."""
        start = perf_counter()
        centroids = {
            eye: ideal_centroids(
                binary_centroids(marker_channel(images, eye, self._color, others_weight), box, self._layout),
                self._rig,
                eye,
            )
            for eye, box in boxes.items()
        }
        measured = perf_counter()
        left, right = (centroids.get(eye, NOTHING) for eye in EYES)
        observation = correspond(left, right, self._rig, self._layout)
        if isinstance(observation, Observation):
            observation = replace(observation, tolerances=self._tolerances)
        stage_s = {"centroids": measured - start, "correspond": perf_counter() - measured}
        return Sighting(observation, stage_s, others_weight, self._blind_eye(centroids, observation))

    def _blind_eye(self, centroids: dict[Eye, Centroids], observation: Observation | NoFixReason) -> str:
        """Why one eye shows nothing where only the other one does; else empty."""
        if isinstance(observation, NoFixReason) or observation.seen.any(axis=1).all():
            return ""
        eye = EYES[int(np.argmin(observation.seen.any(axis=1)))]
        return no_ring(centroids[eye], eye) if eye in centroids else f"no drogue detected in the {eye} image"

    def estimate(self, frame_index: int, images: StereoImages, methods: Sequence[str]) -> list[Estimate]:
        """Answers of every method on the same measurements, in the order of `methods`.

        Raises:
            ValueError: a method that does not exist.
        """
        rough = self.observe(images)
        wants_edges = {method: self._wants_edges(method) for method in methods}
        fine = self.refine(images, rough) if any(wants_edges.values()) else rough
        return [estimate_pose(frame_index, fine if wants_edges[method] else rough, method) for method in methods]

    def refine(self, images: StereoImages, sighting: Sighting) -> Sighting:
        """The same markers by the edge model, with the hub."""
        if isinstance(sighting.observation, NoFixReason):
            return sighting
        start = perf_counter()
        observation = refine(images, self._color, sighting.observation, sighting.others_weight)
        return replace(
            sighting, observation=observation, stage_s={**sighting.stage_s, "refine": perf_counter() - start}
        )

    def _wants_edges(self, method: str) -> bool:
        return self._centroids == "edge" or (self._centroids == "own" and method not in BINARY_METHODS)


def _seen(sighting: Sighting) -> tuple[int, int]:
    """How many markers both eyes measured, and how many measurements there are."""
    observation = sighting.observation
    return (
        (0, 0) if isinstance(observation, NoFixReason) else (int(observation.paired.sum()), int(observation.seen.sum()))
    )


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
        return NoFix(
            frame_index=frame_index,
            method=method,
            reason=f"{solution.reason}: {sighting.blind_eye}" if sighting.blind_eye else solution.reason,
            features=_features(observation, np.zeros_like(observation.seen), None),
            stage_s=stage_s,
        )
    return PoseEstimate(
        frame_index=frame_index,
        method=method,
        left_from_drogue=solution.left_from_drogue,
        covariance=solution.covariance,
        modes=tuple(Mode(left_from_drogue=mode.left_from_drogue, weight=mode.weight) for mode in solution.modes),
        features=_features(observation, solution.used, solution.used_hub),
        stage_s=stage_s,
    )


def _features(
    observation: Observation, used: NDArray[np.bool_], used_hub: NDArray[np.bool_] | None
) -> tuple[Feature, ...]:
    """Markers of both eyes, then the hub's outer edge, where the images show them."""
    features = []
    assert observation.hub_cov_px2 is not None
    markers_px, hub_px = real_observation_px(observation)
    for eye in range(len(EYES)):
        for index in np.flatnonzero(observation.seen[eye]):
            place = markers_px[eye, index], observation.cov_px2[eye, index]
            features.append(_feature(EYES[eye], int(index), place, bool(used[eye, index])))
        if observation.hub_seen[eye, OUTER_EDGE]:
            place = hub_px[eye, OUTER_EDGE], observation.hub_cov_px2[eye, OUTER_EDGE]
            hub_used = used_hub is not None and bool(used_hub[eye, OUTER_EDGE])
            features.append(_feature(EYES[eye], "hub", place, hub_used))
    return tuple(features)


def _feature(eye: Eye, index: int | Literal["hub"], place: tuple[Array, Array], used: bool) -> Feature:
    (x, y), ((a, b), (c, d)) = place[0].tolist(), place[1].tolist()
    return Feature(eye=eye, index=index, center_px=(x, y), cov_px2=((a, b), (c, d)), used=used)
