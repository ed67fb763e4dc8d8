"""One stereo pair through detector, centroids and correspondence, then through every method.

Correspondence assigns the regions of both images to the drogue's markers. First the drogue's ring is found among the
regions of each image (`nav.matching.ring_matching`). That orders the markers up to the layout's symmetry, with gaps for
missing ones. An image with too few markers for a ring of its own is searched where the other image's ring predicts it.
Where the image's edge cuts the ring, the remaining part is enough if both images show it. Then every rotation of the
right image's order against the left's is tried, and the one with the smallest epipolar and disparity cost is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Estimate, Region
from datasets_manifest.types.images import Pixels, StereoImages
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from nav.centroids.binary_centroids import (
    NO_CENTROIDS,
    BinaryCentroids,
    box_window,
    face_centroids,
    layout_with_room,
    small_centroids,
    smallest_gap_m,
    window_centroids,
)
from nav.centroids.small_discs import EDGELESS_RADIUS_PX, LARGEST_SMALL_RADIUS_PX
from nav.detector.detector import Detector
from nav.detector.ring_detectors import ColorBlobDetector
from nav.lens_correction import undistort_centroids
from nav.matching.face_ring import DROWNED_RADIUS_PX
from nav.matching.marker_channel import OTHERS_WEIGHTS, PLAIN, marker_channel, marker_color
from nav.matching.rim_edges import measure_rim
from nav.matching.ring_matching import (
    FEW,
    RingMatch,
    least_markers,
    match_cut_ring,
    match_ring,
    match_ring_near,
    symmetry_permutations,
)
from nav.numerics.eye_threads import map_eyes
from nav.numerics.medians import median
from nav.pair_measurement import PairMeasurement, estimate_pose, regions_of
from nav.pose.pose_method import EXACT, NoFixReason, Observation, Solution, StatedTolerances
from nav.refinement import refine
from nav.tracking.region import Box, rim_boxes

Result = TypeVar("Result")
# Sources of regions that are not a tracker's: the detector, or a prediction from the other eye.
DETECTOR, OTHER_EYE = "detector", "other eye"
NOT_DETECTED = NoFixReason("no drogue detected in the left image, nor in the right one")
CentroidChoice = Literal["own", "binary", "edge"]
CENTROID_CHOICES: tuple[CentroidChoice, ...] = ("own", "binary", "edge")
# The methods of the seed paper and of those that it compares itself with.
BINARY_METHODS = frozenset(
    {"paper", "paper-literal", "circle-fit", "mono-circle", "mean-plane", "disparity-plane", "constant"}
)
# Those that measure the rim's edge instead of markers.
RIM_METHODS = frozenset({"joint-rim"})

# Three markers determine a pose.
_LEAST_MARKERS = 3
# The best rotation must fit the pairs within this share of the gap between neighbours; a wrong one is off by a gap.
_LARGEST_COST_FRACTION = 0.35
# Largest scale of a ring, which is drawn out at the side of a wide image, over focal length by distance. Tilted by up
# to 20 degrees it reaches 1.38 in images of 1280 px with a focal length of 500 px.
_LARGEST_STRETCH = 1.5
# Where both images show a part of the ring only, the pairs must fit better. Drawn ones, tilted by up to 20 degrees,
# have 0.033 of the gap at most.
_LARGEST_COST_FRACTION_OF_PARTS = 0.05
# Markers in the other image of four that the image's edge leaves: six coordinates, and the row and size of each.
_FEWEST_BESIDE_A_CUT_RING = 3
# A pair whose rows differ by more than this is not one marker: room for the rig's calibration, and six deviations.
_ROW_TOLERANCE_PX = 1.0
_ROW_TOLERANCE_SIGMA = 6.0
# A marker cut by something before it has lost a third of its area before its centre is a fifth of a radius off.
_AREA_FACTOR = 1.5


class PairNavigator:
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
        fault = self._unusable(images)
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
        fault = self._unusable(images) or too_few_markers(self._layout)
        if fault is not None or not regions:
            return PairMeasurement(fault or NOT_DETECTED, {}, regions=regions)
        best = self._matched(images, regions, PLAIN)
        has_others = self._color is not None and images.left.ndim == 3
        for weight in OTHERS_WEIGHTS[1:] if has_others else ():
            if best.markers[0] == self._layout.count:
                break
            again = self._matched(images, regions, weight)
            spent_s = {stage: best.stage_s[stage] + again.stage_s[stage] for stage in best.stage_s}
            best = replace(max(best, again, key=lambda measurement: measurement.markers), stage_s=spent_s)
        return best

    def _unusable(self, images: StereoImages) -> NoFixReason | None:
        """Why nothing can be measured in these images."""
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
            scale_px_per_m = max(boxes[eye][2:]) / (2 * self._rim_radius_m)
            return undistort_centroids(self._centroids_in(channel, window[:2], scale_px_per_m), self._rig, eye)

        centroids = map_eyes(centroids_of, boxes, max(box[2] * box[3] for box in boxes.values()))
        measured = perf_counter()
        left, right = (centroids.get(eye, NO_CENTROIDS) for eye in EYES)
        observation = correspond(left, right, self._rig, self._layout)
        if isinstance(observation, Observation):
            observation = replace(observation, tolerances=self._tolerances)
        stage_s = {"centroids": measured - start, "correspond": perf_counter() - measured}
        return PairMeasurement(observation, stage_s, others_weight, self._blind_eye(centroids, observation), regions)

    def _centroids_in(self, channel: Pixels, corner_px: tuple[int, int], scale_px_per_m: float) -> BinaryCentroids:
        """Regions in a part of an image, or peaks of light where the markers are too small for regions."""
        radius_px, place = self._layout.radius_m * scale_px_per_m, (corner_px, self._layout, scale_px_per_m)
        # The light of all lamps of a face counts at once there, and peaks of single ones drown in the sky beside them.
        if radius_px < DROWNED_RADIUS_PX and (face := face_centroids(channel, *place)) is not None:
            return face
        peaks = None
        if radius_px < EDGELESS_RADIUS_PX:
            peaks = small_centroids(channel, *place)
            if peaks.ring is not None:
                return peaks
        regions = window_centroids(channel, corner_px, self._layout)
        if regions.ring is not None or radius_px > LARGEST_SMALL_RADIUS_PX:
            return regions
        peaks = peaks or small_centroids(channel, *place)
        return peaks if peaks.ring is not None else face_centroids(channel, *place) or peaks

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
        measured = {method: fine if wants_edges[method] else rough for method in methods}
        if not RIM_METHODS.isdisjoint(methods):
            measured |= dict.fromkeys(RIM_METHODS, self.measure_rim(images, rough))
        return [estimate_pose(frame_index, measured[method], method) for method in methods]

    def measure_rim(self, images: StereoImages, measurement: PairMeasurement) -> PairMeasurement:
        """Measure the rim's edge where the markers of a pair were searched, found or not."""
        rig, rim, regions = self._rig, self._layout.rim, measurement.regions
        stage_s = {stage: s for stage, s in measurement.stage_s.items() if stage == "detect"}
        fault = self._unusable(images)
        if fault is None and not regions:
            seen = measurement.observation
            # A drogue without markers is no reason here.
            fault = seen if isinstance(seen, NoFixReason) and seen != too_few_markers(self._layout) else NOT_DETECTED
        if fault is not None:
            return PairMeasurement(fault, stage_s)
        start = perf_counter()
        edges = None
        if rim is not None and rim.is_known:
            boxes = {region.eye: region.box_xywh_px for region in regions}
            edges = measure_rim(images, rig, self._boxes_in_both(boxes), 2 * rim.tube_radius_m / rim.radius_m)
        none = np.full((len(EYES), self._layout.count, 2), np.nan)
        no_cov = np.full((*none.shape, 2), np.nan)
        observation = Observation(rig, self._layout, none, no_cov, tolerances=self._tolerances, rim=edges)
        return PairMeasurement(observation, stage_s | {"rim": perf_counter() - start}, regions=regions)

    def _boxes_in_both(self, boxes: dict[Eye, Box]) -> dict[Eye, Box]:
        """Boxes in both eyes; one that was not found lies where the size of the other one puts it."""
        if len(boxes) == len(EYES):
            return boxes
        ((eye, (x, y, width, height)),) = boxes.items()
        middle_px = np.array([x + width / 2, y + height / 2])
        lens = self._rig.lens(eye)
        if lens is not None:
            # Beyond the image a lens may fold, and has no rays.
            middle_px = np.clip(middle_px, 0.0, [lens.camera.width_px - 1.0, lens.camera.height_px - 1.0])
        # What a pixel spans there, along both axes, on a plane at a distance of one.
        steps = self._rig.rays(middle_px + np.eye(2) / 2, eye) - self._rig.rays(middle_px - np.eye(2) / 2, eye)
        depth_m = 2 * self._rim_radius_m / (np.linalg.norm(steps, axis=-1) * (width, height)).max()
        middle_m = depth_m * self._rig.rays(middle_px, eye) + self._rig.eye_offset_m(eye)
        predicted = rim_boxes(self._rig, self._rim_radius_m, RigidTransform(np.eye(3), middle_m))
        others = {region.eye: region.box_xywh_px for region in regions_of(predicted, OTHER_EYE)}
        return others | boxes

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
        if method in RIM_METHODS:
            return False
        return self._centroids == "edge" or (self._centroids == "own" and method not in BINARY_METHODS)


def too_few_markers(layout: MarkerLayout) -> NoFixReason | None:
    """Why a drogue's markers can give no pose; None where they can."""
    if layout.count >= _LEAST_MARKERS:
        return None
    has = "no markers" if layout.count == 0 else f"{layout.count} marker{'s' * (layout.count > 1)}"
    return NoFixReason(f"the drogue has {has}, a pose needs {_LEAST_MARKERS}; joint-rim measures its rim")


@dataclass(frozen=True, eq=False)
class _EyeMarkers:
    """Markers of one eye in the layout's order; NaN where one was not found."""

    centers_px: Array
    cov_px2: Array

    def reordered(self, permutation: NDArray[np.int64]) -> _EyeMarkers:
        """The same markers in the order of a layout rotated onto itself."""
        return _EyeMarkers(self.centers_px[permutation], self.cov_px2[permutation])


def correspond(
    left: BinaryCentroids, right: BinaryCentroids, rig: StereoRig, layout: MarkerLayout
) -> Observation | NoFixReason:
    """Match regions of both eyes with each other and with the drogue's markers.

    The roll that the layout's symmetry leaves open is the one nearest to zero.

    Args:
        left: regions found in the left image.
        right: regions found in the right image.
        rig: the stereo rig.
        layout: the drogue's markers.

    Returns:
        The observation for the pose methods, with NaN for an eye that shows no ring; or the reason why neither eye
        shows one.
    """
    rings = _match_rings(left, right, rig, layout)
    permutations = symmetry_permutations(layout)
    if rings[0] is None and rings[1] is None:
        return NoFixReason(f"{explain_no_match(left, 'left')}, and {explain_no_match(right, 'right')}")
    unclear = [eye for eye, ring in zip(EYES, rings, strict=True) if ring is not None and ring.is_ambiguous]
    if unclear:
        return NoFixReason(f"the {unclear[0]} image is ambiguous: its regions fit the markers in more than one order")
    if rings[0] is None or rings[1] is None:
        eye, ring, centroids = (1, rings[1], right) if rings[0] is None else (0, rings[0], left)
        assert ring is not None
        only = _markers(centroids, ring).reordered(permutations[_rotation_nearest_to_zero(ring, layout)])
        return Observation(rig, layout, *_one_eye_arrays(only, eye))
    upright = permutations[_rotation_nearest_to_zero(rings[0], layout)]
    first = _markers(left, rings[0]).reordered(upright)
    second = _markers(right, rings[1])
    disparity_px = rig.baseline_m * rings[0].scale_px_per_m
    is_part = max(rings[0].count, rings[1].count) < least_markers(layout)
    stretch = 1.0 if is_part else _LARGEST_STRETCH
    costs = _costs_px(first.centers_px, second.centers_px[permutations], (disparity_px / stretch, disparity_px))
    best = int(np.argmin(costs))
    gap_px = smallest_gap_m(layout) * rings[0].scale_px_per_m
    if costs[best] > (_LARGEST_COST_FRACTION_OF_PARTS if is_part else _LARGEST_COST_FRACTION) * gap_px:
        return NoFixReason(f"the rings of both images do not belong together: they differ by {costs[best]:.1f} px")
    return Observation(rig, layout, *_without_bad_pairs(first, second.reordered(permutations[best])))


def _match_rings(
    left: BinaryCentroids, right: BinaryCentroids, rig: StereoRig, layout: MarkerLayout
) -> list[RingMatch | None]:
    """The ring in each image; where only one image shows it by itself, the other is searched where it must be."""
    rings = [centroids.ring or match_ring(centroids.blobs, _sized(layout, centroids)) for centroids in (left, right)]
    if rings[0] is None and rings[1] is None:
        return _match_cut_rings(left, right, rig, layout)
    return _match_missing_eye(rings, (left, right), rig, layout, FEW)


def _match_cut_rings(
    left: BinaryCentroids, right: BinaryCentroids, rig: StereoRig, layout: MarkerLayout
) -> list[RingMatch | None]:
    """The part of the ring that the images' edges leave, in both images or in none."""
    size_px = rig.camera.width_px, rig.camera.height_px
    parts = [
        match_cut_ring(seen.blobs, _sized(layout, seen), size_px, partial(rig.image_px, eye=eye))
        for seen, eye in zip((left, right), EYES, strict=True)
    ]
    parts = _match_missing_eye(parts, (left, right), rig, layout, _FEWEST_BESIDE_A_CUT_RING)
    return [None, None] if parts[0] is None or parts[1] is None else parts


def _match_missing_eye(
    rings: list[RingMatch | None],
    seen: tuple[BinaryCentroids, BinaryCentroids],
    rig: StereoRig,
    layout: MarkerLayout,
    least: int,
) -> list[RingMatch | None]:
    """The rings, completed where only one image shows one by at least this many markers where it predicts them."""
    found = list(rings)
    for eye, toward_px in ((0, 1.0), (1, -1.0)):
        other = rings[1 - eye]
        if rings[eye] is None and other is not None:
            disparity_px = rig.baseline_m * other.scale_px_per_m
            expected = other.moved((toward_px * disparity_px, 0.0)).affine
            found[eye] = match_ring_near(seen[eye].blobs, _sized(layout, seen[eye]), expected, least)
    return found


def _sized(layout: MarkerLayout, centroids: BinaryCentroids) -> MarkerLayout:
    """The layout for the matching of regions: peaks without a size have the room that a marker has to itself."""
    return layout if centroids.room_m is None else layout_with_room(layout, centroids.room_m)


def explain_no_match(centroids: BinaryCentroids, eye: Eye) -> str:
    """The reason why an eye has no markers."""
    what = "regions" if centroids.room_m is None else "peaks of light"
    return f"no ring of markers among {len(centroids.blobs)} {what} of the {eye} image"


def _one_eye_arrays(only: _EyeMarkers, eye: int) -> tuple[Array, Array]:
    """Centres (2, N, 2) and covariances (2, N, 2, 2) with one eye's markers and NaN for the other eye."""
    pixels = np.full((len(EYES), *only.centers_px.shape), np.nan)
    covariances = np.full((len(EYES), *only.cov_px2.shape), np.nan)
    pixels[eye], covariances[eye] = only.centers_px, only.cov_px2
    return pixels, covariances


def _markers(centroids: BinaryCentroids, ring: RingMatch) -> _EyeMarkers:
    """The ring's regions in the layout's order, without those whose area is an outlier."""
    found = ring.blob_of_marker >= 0
    blob = ring.blob_of_marker[found]
    areas = centroids.blobs.areas_px2[blob]
    whole = np.abs(np.log(areas / median(areas))) < np.log(_AREA_FACTOR)
    found[found] = whole
    centers = np.full((len(found), 2), np.nan)
    covariances = np.full((len(found), 2, 2), np.nan)
    centers[found], covariances[found] = centroids.blobs.centers_px[blob[whole]], centroids.cov_px2[blob[whole]]
    return _EyeMarkers(centers, covariances)


def _rotation_nearest_to_zero(ring: RingMatch, layout: MarkerLayout) -> int:
    """Index of the layout's rotation that brings the ring's roll nearest to zero."""
    linear = ring.affine[:, :2]
    roll = np.arctan2(linear[1, 0] - linear[0, 1], linear[0, 0] + linear[1, 1])
    order = layout.symmetry_order
    # Renumbering the markers by a rotation of 2 pi k / order subtracts that much from the roll.
    return int(np.round(roll * order / (2 * np.pi))) % order


def _costs_px(left_px: Array, right_px: Array, disparities_px: tuple[float, float]) -> Array:
    """(T,) root mean squares of row differences, and of disparities against one of all, infinite without pairs.

    Args:
        left_px: (N, 2) markers.
        right_px: (T, N, 2) the same in every turn.
        disparities_px: the least and the largest by the ring's size; the mean of a turn's pairs is taken between them.
    """
    gaps_px = left_px - right_px
    both = np.isfinite(gaps_px)
    count = both.sum(axis=(1, 2))
    sums_px = np.where(both, gaps_px, 0.0)[..., 0].sum(axis=1)
    gaps_px[..., 0] -= np.clip(2 * sums_px / np.maximum(count, 1), *disparities_px)[:, None]
    squares = gaps_px**2
    costs: Array = np.sqrt(np.where(both, squares, 0.0).sum(axis=(1, 2)) / np.maximum(count, 1))
    return np.where(count > 0, costs, np.inf)


def _without_bad_pairs(left: _EyeMarkers, right: _EyeMarkers) -> tuple[Array, Array]:
    """Centres (2, N, 2) and covariances (2, N, 2, 2), NaN for pairs whose row difference is an outlier."""
    rows_px = left.centers_px[:, 1] - right.centers_px[:, 1]
    both = np.isfinite(rows_px)
    sigma_px = np.sqrt(left.cov_px2[:, 1, 1] + right.cov_px2[:, 1, 1])
    bad = np.zeros_like(both)
    off_px = np.abs(rows_px[both] - median(rows_px[both]))
    bad[both] = off_px > _ROW_TOLERANCE_PX + _ROW_TOLERANCE_SIGMA * sigma_px[both]
    pixels = np.stack([left.centers_px, right.centers_px])
    covariances = np.stack([left.cov_px2, right.cov_px2])
    pixels[:, bad], covariances[:, bad] = np.nan, np.nan
    return pixels, covariances
