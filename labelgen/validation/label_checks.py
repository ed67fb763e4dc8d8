"""Labels against the passes they were made with, and against OpenCV's projection.

`check_against_passes` runs on every frame before it is written; `droguekit validate` uses the other checks.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.records import FeatureView, NeighbourView, PairRecord, PixelBox, ViewRecord
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP, drogue_part_ids
from geometry.distortion import Lens
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.disc_images import DiscInEye, hub_discs, marker_discs
from labelgen.label_errors import ARITHMETIC_PX, LATTICE_LIMIT_RMS, centroid_error
from labelgen.part_pixels import FeaturePixels, drogue_mask, parts_mask
from render.engine import EyeRadiance, StereoRadiance

# Meshes draw circles as polygons of 128 sides and the same area, whose corners stand out by (pi / 128)^2 / 6 = 1e-4.
_OUTLINE_TOLERANCE = 5e-4

# Rays, vertices and the product of a few transforms, each rounded to float32 at the scale of the distance.
_DEPTH_ROUNDINGS = 32.0

# The rows of both eyes are computed from the same numbers.
_EPIPOLAR_TOLERANCE_PX = 1e-9


def check_against_passes(record: PairRecord, radiance: StereoRadiance) -> list[str]:
    """Contradictions between the labels of a pair and its passes, one line each; empty without faults.

    Checked: the part id at the centre of every unoccluded marker; that every pixel of a marker or the hub lies on it
    and has the depth of its plane; the centroid of every unoccluded marker's pixels against `center_ellipse_px`;
    visible against amodal pixels; the boxes against the pixels; that an empty frame shows no drogue.
    """
    faults = []
    for eye, seen in zip(EYES, (radiance.left, radiance.right), strict=True):
        view = record.views.left if eye == "left" else record.views.right
        drogue, pose = record.frame.drogue, record.left_from_drogue
        if drogue is None or pose is None:
            found = check_empty(view, seen.part_id)
        else:
            found = _check_drogue(record, drogue, pose, eye, seen)
        faults += [f"frame {record.frame_index}, {eye}: {fault}" for fault in found]
    return faults


def check_empty(view: ViewRecord, part_id: NDArray[np.uint8]) -> list[str]:
    """Faults of one eye of a frame without a drogue."""
    faults = []
    if view.markers or view.hub or view.box_full_xywh_px or view.box_visible_xywh_px or view.visible_drogue_px:
        faults.append("has labels of a drogue although the frame is empty")
    belongs = np.isin(part_id, drogue_part_ids(0)) | (part_id >= FIRST_MARKER_ID)
    if belongs.any():
        faults.append(f"{np.count_nonzero(belongs)} pixels show a drogue although the frame is empty")
    return faults


def check_boxes(view: ViewRecord | NeighbourView, mask: NDArray[np.bool_]) -> list[str]:
    """Faults of one eye's boxes of a drogue against the (H, W) pixels that see it."""
    faults = []
    count = int(np.count_nonzero(mask))
    if count != view.visible_drogue_px:
        faults.append(f"visible_drogue_px: is {view.visible_drogue_px}, the part ids have {count}")
    box = view.box_visible_xywh_px
    if (box is None) != (count == 0):
        faults.append(f"box_visible_xywh_px: is {box} with {count} visible pixels")
    elif box is not None:
        column, row, width, height = cv2.boundingRect(mask.view(np.uint8))
        want = (column - 0.5, row - 0.5, float(width), float(height))
        if box != want:
            faults.append(f"box_visible_xywh_px: is {box}, the part ids have {want}")
        full = view.box_full_xywh_px
        # A pixel reaches half a pixel beyond its centre on either side.
        if full is None or not _contains(full, box, margin_px=1.0):
            faults.append(f"box_visible_xywh_px: {box} is not inside box_full_xywh_px {full}")
    return faults


def check_neighbours(record: PairRecord, view: ViewRecord, part_id: NDArray[np.uint8]) -> list[str]:
    """Faults of one eye's boxes of the drogues beside the sought one."""
    others = record.frame.neighbours
    if len(view.neighbours) != len(others):
        return [f"neighbours: {len(view.neighbours)} are labelled, the frame has {len(others)}"]
    faults = []
    for index, (seen, other) in enumerate(zip(view.neighbours, others, strict=True)):
        found = check_boxes(seen, drogue_mask(part_id, other.drogue.marker_count, index + 1))
        faults += [f"neighbours[{index}]: {fault}" for fault in found]
    beyond = INSTANCE_STEP * (len(others) + 1)
    if (part_id >= beyond).any():
        faults.append(f"neighbours: {np.count_nonzero(part_id >= beyond)} pixels show one that the frame has not")
    return faults


def check_unoccluded_marker(
    view: FeatureView, disc: DiscInEye, part_id: NDArray[np.uint8], pixels: FeaturePixels
) -> list[str]:
    """Faults of a marker that is wholly visible, against the part ids and its pixels among them."""
    faults = []
    if not disc.camera.contains(view.center_proj_px):
        return [f"in_image: is true, center_proj_px {view.center_proj_px} is not on the image"]
    column, row = (int(value) for value in np.rint(np.clip(view.center_proj_px, 0, np.array(part_id.shape[::-1]) - 1)))
    # A marker smaller than a pixel can have its centre's pixel centre outside.
    inside = float(disc.distance_m(np.array([column, row]))) < 0.9 * disc.radius_m
    if inside and part_id[row, column] != disc.part:
        faults.append(f"center_proj_px: pixel {column}, {row} sees part {part_id[row, column]}, not {disc.part}")
    error_px, rms_px = centroid_error(view, disc, pixels)
    if np.hypot(*error_px) > LATTICE_LIMIT_RMS * rms_px:
        faults.append(
            f"center_ellipse_px: is {np.hypot(*error_px):.3f} px from the centroid of part {disc.part}, "
            f"more than {LATTICE_LIMIT_RMS * rms_px:.3f} px"
        )
    return faults


def _check_drogue(
    record: PairRecord, drogue: DrogueParameters, pose: RigidTransform, eye: Eye, seen: EyeRadiance
) -> list[str]:
    """Faults of one eye of a frame with a drogue."""
    view = record.views.left if eye == "left" else record.views.right
    layout = marker_layout(drogue)
    if len(view.markers) != layout.count or (view.hub is None) != (layout.hub_center_m is None):
        return [f"markers, hub: {len(view.markers)} markers are labelled, the drogue has {layout.count}"]
    pixels = FeaturePixels(seen.part_id)
    faults = check_boxes(view, parts_mask(seen.part_id, drogue_part_ids(layout.count)))
    faults += check_neighbours(record, view, seen.part_id)
    for name, feature, disc in named_features(record, layout, pose, eye):
        hole_m = layout.hub_inner_radius_m if name == "hub" else 0.0
        found = _check_visibility(feature, pixels.count(disc.part), seen.amodal_px.get(disc.part, 0))
        found += check_feature_pixels(disc, hole_m, seen.depth_m, pixels)
        if name != "hub" and feature.in_image and feature.visible_fraction == 1:
            found += check_unoccluded_marker(feature, disc, seen.part_id, pixels)
        faults += [f"{name}: {fault}" for fault in found]
    return faults


def named_features(
    record: PairRecord, layout: MarkerLayout, pose: RigidTransform, eye: Eye
) -> list[tuple[str, FeatureView, DiscInEye]]:
    """Markers and hub of one eye: name, label and disc (of the hub's outer edge)."""
    view = record.views.left if eye == "left" else record.views.right
    rig = record.frame.rig
    discs = marker_discs(layout, rig, pose, eye)
    named: list[tuple[str, FeatureView, DiscInEye]] = [
        (f"markers[{index}]", feature, disc)
        for index, (feature, disc) in enumerate(zip(view.markers, discs, strict=True))
    ]
    hub = hub_discs(layout, rig, pose, eye)
    if hub is not None and view.hub is not None:
        named.append(("hub", view.hub, hub[0]))
    return named


def _check_visibility(feature: FeatureView, visible: int, amodal: int) -> list[str]:
    if visible > amodal:
        return [f"{visible} pixels are visible of only {amodal}"]
    want = visible / amodal if amodal else 0.0
    return [] if feature.visible_fraction == want else [f"visible_fraction: is {feature.visible_fraction}, not {want}"]


def check_feature_pixels(
    disc: DiscInEye, hole_m: float, depth_m: NDArray[np.float32], pixels: FeaturePixels
) -> list[str]:
    """Faults of the pixels of a feature: pixels beyond its edge, and depths off its plane.

    Args:
        disc: the feature's.
        hole_m: radius of its hole. [m]
        depth_m: (H, W) planar depth. [m]
        pixels: of all features in the eye's image.
    """
    rows, columns = pixels.indices(disc.part)
    places_px = np.stack([columns, rows], axis=-1).astype(np.float64)
    distance_m = disc.distance_m(places_px)
    faults = []
    beyond = int(np.count_nonzero(distance_m > disc.radius_m * (1 + _OUTLINE_TOLERANCE)))
    if beyond:
        faults.append(f"{beyond} pixels of part {disc.part} lie beyond its edge")
    # On the outline a ray may pass between two touching parts; through the hole it sees the inner wall.
    on_face = (distance_m > hole_m * (1 + _OUTLINE_TOLERANCE)) & (distance_m < disc.radius_m * (1 - _OUTLINE_TOLERANCE))
    if not on_face.any():
        return faults
    rows, columns, places_px = rows[on_face], columns[on_face], places_px[on_face]
    error_m = np.abs(depth_m[rows, columns].astype(np.float64) - disc.plane_depth_m(places_px))
    rays = disc.rays(places_px)
    slant = np.abs(rays @ disc.normal) / np.linalg.norm(rays, axis=-1)
    reach_m = float(np.linalg.norm(disc.center_m)) + disc.radius_m
    limit_m = _DEPTH_ROUNDINGS * float(np.finfo(np.float32).eps) * reach_m / slant
    worst = int(np.argmax(error_m / limit_m))
    # NaN is a fault too.
    if not error_m[worst] <= limit_m[worst]:
        faults.append(
            f"depth at pixel {columns[worst]}, {rows[worst]} is {error_m[worst]:.2e} m off the plane of part "
            f"{disc.part}, more than {limit_m[worst]:.2e} m"
        )
    return faults


def _contains(outer: PixelBox, inner: PixelBox, margin_px: float) -> bool:
    return bool(
        inner[0] >= outer[0] - margin_px
        and inner[1] >= outer[1] - margin_px
        and inner[0] + inner[2] <= outer[0] + outer[2] + margin_px
        and inner[1] + inner[3] <= outer[1] + outer[3] + margin_px
    )


def projection_faults(record: PairRecord) -> list[str]:
    """Faults of the centres of markers and hub, and of the corners of a calibration board."""
    if record.frame.board is not None:
        board = record.frame.board
        corners_m = board.shape.corners_m()
        labels = dict.fromkeys(EYES, record.views.left.board_corners_px) | {
            "right": record.views.right.board_corners_px
        }
        names = [f"board_corners_px[{index}]" for index in range(len(corners_m))]
        labelled = {eye: np.array(labels[eye], dtype=np.float64).reshape(-1, 2) for eye in EYES}
        return _point_faults(record.frame.rig, board.left_from_board, corners_m, labelled, names)
    if record.views.left.board_corners_px or record.views.right.board_corners_px:
        return ["board_corners_px: are given, the frame has no board"]
    pose, drogue = record.left_from_drogue, record.frame.drogue
    if pose is None or drogue is None:
        return []
    layout = marker_layout(drogue)
    centers_m = layout.centers_m
    if layout.hub_center_m is not None:
        centers_m = np.vstack([centers_m, layout.hub_center_m])
    if any(len(view.markers) != layout.count for view in (record.views.left, record.views.right)):
        return [f"markers: must be the drogue's {layout.count} in both eyes"]
    named = {eye: named_features(record, layout, pose, eye) for eye in EYES}
    labelled = {eye: np.array([view.center_proj_px for _, view, _ in named[eye]]).reshape(-1, 2) for eye in EYES}
    names = [f"{name}: center_proj_px" for name, _, _ in named["left"]]
    return _point_faults(record.frame.rig, pose, centers_m, labelled, names)


def box_faults(record: PairRecord) -> list[str]:
    """Centres of markers and hub that lie outside the drogue's full box.

    Through a lens only those on the image: the box and the centres of others may end with the lens's field.
    """
    faults = []
    for eye in EYES:
        view = record.views.left if eye == "left" else record.views.right
        if view.box_full_xywh_px is None:
            continue
        low = np.array(view.box_full_xywh_px[:2])
        high = low + view.box_full_xywh_px[2:]
        features = [*view.markers, *([view.hub] if view.hub is not None else [])]
        for index, feature in enumerate(features):
            point = np.array(feature.center_proj_px)
            if record.frame.rig.lens(eye) is not None and not record.frame.rig.camera.contains(point):
                continue
            if not ((point >= low) & (point <= high)).all():
                name = f"markers[{index}]" if index < len(view.markers) else "hub"
                faults.append(f"{eye}: {name}: center_proj_px {feature.center_proj_px} lies outside box_full_xywh_px")
    return faults


def _point_faults(
    rig: StereoRig, pose: RigidTransform, points_m: Array, labelled: dict[Eye, Array], names: list[str]
) -> list[str]:
    """Faults of (N, 2) labels of both eyes against the images of (N, 3) points at a pose; N may be 0."""
    faults, ideal, seen = [], {}, np.ones(len(points_m), dtype=np.bool_)
    if len(points_m) == 0 and not any(map(len, labelled.values())):
        return []
    for eye in EYES:
        if len(labelled[eye]) != len(points_m):
            return [f"{eye}: has {len(labelled[eye])} features, there are {len(points_m)}"]
        lens = rig.lens(eye) or Lens(rig.camera)
        real_from_ideal = lens.ideal_from_real.T
        turn, _ = cv2.Rodrigues(real_from_ideal @ pose.rotation)
        offset = real_from_ideal @ (pose.translation_m - rig.eye_offset_m(eye))
        want, _ = cv2.projectPoints(points_m, turn, offset, lens.camera.matrix(), lens.distortion.coefficients())
        error = np.abs(labelled[eye] - want.reshape(-1, 2)).max(axis=1)
        in_field = rig.is_in_field(rig.project(pose.apply(points_m), eye), eye)
        for index in np.flatnonzero(in_field & ~(error <= ARITHMETIC_PX)):
            faults.append(f"{eye}: {names[index]}: is {error[index]:.3g} px off the pose's image")
        for index in np.flatnonzero(~in_field & rig.camera.contains(labelled[eye])):
            faults.append(f"{eye}: {names[index]}: lies on the image, the lens does not see it")
        seen &= in_field
    for eye in EYES:
        try:
            ideal[eye] = rig.ideal_px(labelled[eye][seen], eye)
        except ValueError:
            return [*faults, f"{eye}: labels lie where the lens sees nothing"]
    gap = float(np.abs(ideal["left"][:, 1] - ideal["right"][:, 1]).max(initial=0.0))
    if not gap <= _EPIPOLAR_TOLERANCE_PX:
        faults.append(f"rows of left and right differ by {gap:.3g} px once rectified")
    return faults
