"""One stereo pair through detector, centroids and correspondence, then through every method."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from time import perf_counter
from typing import Literal, TypeVar

import numpy as np

from datasets_manifest.types.estimates import Estimate, Region
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye, StereoRig
from nav.centroids.binary_centroids import NO_CENTROIDS, BinaryCentroids, box_window, window_centroids
from nav.detector.color_blob import ColorBlobDetector
from nav.detector.detector import Detector
from nav.lens_correction import undistort_centroids
from nav.matching.marker_channel import OTHERS_WEIGHTS, PLAIN, marker_channel, marker_color
from nav.pair_measurement import PairMeasurement, estimate_pose, regions_of
from nav.pose.pose_method import EXACT, NoFixReason, Observation, Solution, StatedTolerances
from nav.refinement import refine
from nav.stereo_correspondence import correspond, explain_no_match
from nav.tracking.rim_boxes import rim_boxes

Result = TypeVar("Result")


def map_views(work: Callable[[Eye], Result], eyes: Collection[Eye]) -> dict[Eye, Result]:
    """Apply a function to each eye; the second eye runs in a thread of its own.

    OpenCV, and numpy on large arrays, release the interpreter lock meanwhile.

    Raises:
        Exception: any exception that `work` raises.
    """
    first, *others = eyes
    waiting = {eye: _other_thread().submit(work, eye) for eye in others}
    results = {first: work(first)}
    return results | {eye: result.result() for eye, result in waiting.items()}


@cache
def _other_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="other-eye")


# Sources of regions that are not a tracker's: the detector, or a prediction from the other eye.
DETECTOR, OTHER_EYE = "detector", "other eye"
NOT_DETECTED = NoFixReason("no drogue detected in the left image, nor in the right one")
# For smaller boxes the handover to another thread takes as long as the work itself.
_LEAST_THREADED_AREA_PX2 = 1e5
CentroidChoice = Literal["own", "binary", "edge"]
CENTROID_CHOICES: tuple[CentroidChoice, ...] = ("own", "binary", "edge")
# The methods of the seed paper and of those that it compares itself with.
BINARY_METHODS = frozenset(
    {"paper", "paper-literal", "circle-fit", "mono-circle", "mean-plane", "disparity-plane", "constant"}
)


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
        self._rig, self._rim_radius_m = rig, drogue.rim_radius_m
        self._layout = marker_layout(drogue)
        self._color = marker_color(drogue)
        self._detector: Detector = ColorBlobDetector(drogue) if detector is None else detector

    @property
    def detector(self) -> Detector:
        """The detector that finds the drogue in whole images."""
        return self._detector

    def observe(self, images: StereoImages) -> PairMeasurement:
        """Detect the drogue in the whole images and measure its markers."""
        fault = self._wrong_size(images)
        if fault is not None:
            return PairMeasurement(fault, {})
        start = perf_counter()
        regions = regions_of(self._detector.detect(images), DETECTOR)
        stage_s = {"detect": perf_counter() - start}
        measurement = self.measure(images, regions)
        return self._with_other_eye(images, replace(measurement, stage_s={**stage_s, **measurement.stage_s}))

    def _with_other_eye(self, images: StereoImages, measurement: PairMeasurement) -> PairMeasurement:
        """Where only one eye shows the ring of markers, measure the other where the ring's pose predicts it."""
        observation = measurement.observation
        if isinstance(observation, NoFixReason) or observation.seen.any(axis=1).all():
            return measurement
        one = measurement.with_rough()
        if not isinstance(one.rough, Solution):
            return one
        boxes = rim_boxes(self._rig, self._rim_radius_m, one.rough.left_from_drogue)
        (found,) = (region for region in one.regions if observation.seen[EYES.index(region.eye)].any())
        ahead = [region for region in regions_of(boxes, OTHER_EYE) if region.eye != found.eye]
        if not ahead:
            return one
        both = {found.eye: found, ahead[0].eye: ahead[0].model_copy(update={"score": found.score})}
        again = self.measure(images, tuple(both[eye] for eye in EYES))
        spent_s = one.stage_s | {stage: one.stage_s.get(stage, 0.0) + s for stage, s in again.stage_s.items()}
        return replace(again if again.markers > one.markers else one, stage_s=spent_s)

    def measure(self, images: StereoImages, regions: tuple[Region, ...]) -> PairMeasurement:
        """Measure the markers in these regions of one pair by the binary chain, and match them."""
        fault = self._wrong_size(images)
        if fault is not None or not regions:
            return PairMeasurement(fault or NOT_DETECTED, {})
        best = self._matched(images, regions, PLAIN)
        has_others = self._color is not None and images.left.ndim == 3
        for weight in OTHERS_WEIGHTS[1:] if has_others else ():
            if best.markers[0] == self._layout.count:
                break
            again = self._matched(images, regions, weight)
            spent_s = {stage: best.stage_s[stage] + again.stage_s[stage] for stage in best.stage_s}
            best = replace(max(best, again, key=lambda measurement: measurement.markers), stage_s=spent_s)
        return best

    def _wrong_size(self, images: StereoImages) -> NoFixReason | None:
        size_px = (self._rig.camera.width_px, self._rig.camera.height_px)
        if images.size_px == size_px:
            return None
        got, want = ("x".join(map(str, size)) for size in (images.size_px, size_px))
        return NoFixReason(f"the images are {got} px, the rig's {want} px")

    def _matched(self, images: StereoImages, regions: tuple[Region, ...], others_weight: float) -> PairMeasurement:
        """Binary centroids within the regions, matched."""
        start = perf_counter()
        boxes = {region.eye: region.box_xywh_px for region in regions}

        def centroids_of(eye: Eye) -> BinaryCentroids:
            window = box_window(images.size_px, boxes[eye])
            if window[0] == window[2] or window[1] == window[3]:
                return NO_CENTROIDS
            channel = marker_channel(images, eye, self._color, others_weight, window)
            return undistort_centroids(window_centroids(channel, window[:2], self._layout), self._rig, eye)

        larger = max(box[2] * box[3] for box in boxes.values())
        centroids = (
            map_views(centroids_of, boxes)
            if larger > _LEAST_THREADED_AREA_PX2
            else {eye: centroids_of(eye) for eye in boxes}
        )
        measured = perf_counter()
        left, right = (centroids.get(eye, NO_CENTROIDS) for eye in EYES)
        observation = correspond(left, right, self._rig, self._layout)
        if isinstance(observation, Observation):
            observation = replace(observation, tolerances=self._tolerances)
        stage_s = {"centroids": measured - start, "correspond": perf_counter() - measured}
        return PairMeasurement(observation, stage_s, others_weight, self._blind_eye(centroids, observation), regions)

    def _blind_eye(self, centroids: dict[Eye, BinaryCentroids], observation: Observation | NoFixReason) -> str:
        """Why one eye shows no markers where the other one does; else empty."""
        if isinstance(observation, NoFixReason) or observation.seen.any(axis=1).all():
            return ""
        eye = EYES[int(np.argmin(observation.seen.any(axis=1)))]
        return explain_no_match(centroids[eye], eye) if eye in centroids else f"no drogue detected in the {eye} image"

    def estimate(self, frame_index: int, images: StereoImages, methods: Sequence[str]) -> list[Estimate]:
        """Estimates by every method from the same measurements, in the order of `methods`.

        Raises:
            ValueError: a method that does not exist.
        """
        return self.estimate_measured(frame_index, images, self.observe(images), methods)

    def estimate_measured(
        self, frame_index: int, images: StereoImages, rough: PairMeasurement, methods: Sequence[str]
    ) -> list[Estimate]:
        """As `estimate`, from markers that were measured already."""
        wants_edges = {method: self._wants_edges(method) for method in methods}
        fine = self.refine(images, rough) if any(wants_edges.values()) else rough
        return [estimate_pose(frame_index, fine if wants_edges[method] else rough, method) for method in methods]

    def refine(self, images: StereoImages, measurement: PairMeasurement) -> PairMeasurement:
        """Measure the same markers by the edge model, and the hub."""
        measurement = measurement.with_rough()
        if isinstance(measurement.observation, NoFixReason) or not isinstance(measurement.rough, Solution):
            return measurement
        start = perf_counter()
        observation = refine(images, self._color, measurement.observation, measurement.rough, measurement.others_weight)
        return replace(
            measurement, observation=observation, stage_s={**measurement.stage_s, "refine": perf_counter() - start}
        )

    def _wants_edges(self, method: str) -> bool:
        return self._centroids == "edge" or (self._centroids == "own" and method not in BINARY_METHODS)
