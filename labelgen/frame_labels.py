"""All labels of one stereo pair: pose, markers, hub, boxes and conditions."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec, OtherDrogue
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import (
    Conditions,
    FeatureView,
    HubView,
    NeighbourView,
    PairRecord,
    PixelPoint,
    StereoViews,
    ViewRecord,
)
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP, MAX_MARKERS, SURROUNDING_PARTS, Part
from geometry.circles import disc_image_centers
from geometry.se3 import Array, RigidTransform, angles_from_rotation
from geometry.stereo import Eye
from labelgen.disc_images import DiscInEye, hub_discs, marker_discs, window_around
from labelgen.part_pixels import drogue_box, drogue_mask, is_truncated, mask_box
from render.camera.sensor import mono_weights
from render.engine import EyeRadiance, StereoRadiance
from scenes.environment_radiance import sun_elevation_deg
from scenes.sky.photometry import REC709_LUMINANCE, infrared_light

# A feature's background reaches from its edge to this multiple of its radius.
_SURROUNDINGS_REACH = 1.8


def label_frame(frame: FrameSpec, radiance: StereoRadiance, images: StereoImages) -> PairRecord:
    """All labels of one pair.

    Args:
        frame: its specification.
        radiance: with the passes that determine visibility.
        images: of the sensor.

    Returns:
        The record, without the hashes of its files.

    Raises:
        ValueError: images or passes do not belong to the frame.
    """
    _check_belongs(frame, radiance, images)
    pose = frame.left_from_drogue
    half_s = frame.exposure.time_s / 2
    pitch, yaw, roll = (None, None, None) if pose is None else _angles_deg(pose)
    views = StereoViews(
        left=_view(frame, pose, "left", radiance.left), right=_view(frame, pose, "right", radiance.right)
    )
    return PairRecord(
        frame_index=frame.frame_index,
        scene_id=frame.scene_id,
        sequence_id=frame.sequence_id,
        time_s=frame.time_s,
        left_from_drogue=pose,
        left_from_drogue_open=None if pose is None else frame.left_from_drogue_at(-half_s),
        left_from_drogue_close=None if pose is None else frame.left_from_drogue_at(half_s),
        pitch_deg=pitch,
        yaw_deg=yaw,
        roll_deg=roll,
        roll_modulo_deg=_roll_modulo_deg(frame, roll),
        views=views,
        conditions=Conditions(
            family=frame.family,
            distance_m=None if pose is None else float(pose.translation_m[2]),
            sun_elevation_deg=sun_elevation_deg(frame.environment),
            background_luminance_cd_m2=_background_luminance_cd_m2(radiance),
            monte_carlo_noise_fraction=radiance.monte_carlo_noise_fraction,
            monte_carlo_over_sensor_noise=radiance.monte_carlo_over_sensor_noise,
            markers_in_view=None if frame.sequence_id is None else _markers_in_view(views),
            hub_in_view=None if frame.sequence_id is None else _hub_in_view(views),
        ),
        engine=radiance.engine,
        engine_version=radiance.engine_version,
        image_black_level_dn=images.black_level_dn,
        file_sha256={},
        frame=frame,
    )


def _check_belongs(frame: FrameSpec, radiance: StereoRadiance, images: StereoImages) -> None:
    camera = frame.rig.camera
    size = (camera.width_px, camera.height_px)
    if images.size_px != size or images.time_s != frame.time_s:
        raise ValueError(f"images: must be {size} px at {frame.time_s} s, got {images.size_px} at {images.time_s} s")
    for name, eye in (("left", radiance.left), ("right", radiance.right)):
        if eye.part_id.shape != size[::-1]:
            raise ValueError(f"radiance.{name}: must be {size[::-1]}, got {eye.part_id.shape}")


def _angles_deg(pose: RigidTransform) -> tuple[float, float, float]:
    pitch, yaw, roll = np.degrees(angles_from_rotation(pose.rotation))
    return float(pitch), float(yaw), float(roll)


def _roll_modulo_deg(frame: FrameSpec, roll_deg: float | None) -> float | None:
    if roll_deg is None or frame.drogue is None:
        return None
    step_deg = 360.0 / marker_layout(frame.drogue).symmetry_order
    modulo = roll_deg % step_deg
    # A tiny negative roll rounds up to the step itself.
    return modulo if modulo < step_deg else 0.0


def _view(frame: FrameSpec, pose: RigidTransform | None, eye: Eye, seen: EyeRadiance) -> ViewRecord:
    if frame.drogue is None or pose is None:
        return ViewRecord(
            markers=(),
            hub=None,
            box_full_xywh_px=None,
            box_visible_xywh_px=None,
            visible_drogue_px=0,
            truncated=False,
            board_corners_px=_board_corners_px(frame, eye),
        )
    layout = marker_layout(frame.drogue)
    mask = drogue_mask(seen.part_id, layout.count)
    box = drogue_box(frame.drogue, frame.rig, pose, eye)
    return ViewRecord(
        markers=marker_views(frame, layout, pose, eye, seen),
        hub=hub_view(frame, layout, pose, eye, seen),
        box_full_xywh_px=box,
        box_visible_xywh_px=mask_box(mask),
        visible_drogue_px=int(np.count_nonzero(mask)),
        truncated=is_truncated(box, frame.rig.camera),
        neighbours=tuple(
            _neighbour_view(frame, other, index + 1, eye, seen) for index, other in enumerate(frame.neighbours)
        ),
    )


def _neighbour_view(frame: FrameSpec, other: OtherDrogue, instance: int, eye: Eye, seen: EyeRadiance) -> NeighbourView:
    """Boxes of a drogue beside the sought one."""
    mask = drogue_mask(seen.part_id, other.drogue.marker_count, instance)
    box = drogue_box(other.drogue, frame.rig, other.left_from_drogue, eye)
    return NeighbourView(
        box_full_xywh_px=box,
        box_visible_xywh_px=mask_box(mask),
        visible_drogue_px=int(np.count_nonzero(mask)),
        truncated=is_truncated(box, frame.rig.camera),
    )


def _markers_in_view(views: StereoViews) -> tuple[int, int]:
    left, right = (sum(marker.in_image for marker in view.markers) for view in (views.left, views.right))
    return left, right


def _hub_in_view(views: StereoViews) -> tuple[bool, bool] | None:
    if views.left.hub is None or views.right.hub is None:
        return None
    return views.left.hub.in_image, views.right.hub.in_image


def _board_corners_px(frame: FrameSpec, eye: Eye) -> tuple[PixelPoint, ...]:
    if frame.board is None:
        return ()
    corners_px = frame.rig.image(frame.board.left_from_board.apply(frame.board.shape.corners_m()), eye)
    return tuple((float(u), float(v)) for u, v in corners_px)


def _background_luminance_cd_m2(radiance: StereoRadiance) -> float:
    """Mean luminance of the sky pixels of both eyes; of all pixels where none sees the sky."""
    eyes = (radiance.left, radiance.right)
    masks = [(eye.part_id == Part.SKY).view(np.uint8) for eye in eyes]
    counts = np.array([np.count_nonzero(mask) for mask in masks], dtype=np.float64)
    if not counts.any():
        masks, counts = (
            [np.ones_like(mask) for mask in masks],
            np.array([mask.size for mask in masks], dtype=np.float64),
        )
    means = np.array(
        [cv2.mean(eye.radiance_cd_m2, mask)[:3] for eye, mask in zip(eyes, masks, strict=True)], dtype=np.float64
    )
    return float(np.average(means, axis=0, weights=counts) @ REC709_LUMINANCE)


def marker_views(
    frame: FrameSpec, layout: MarkerLayout, pose: RigidTransform, eye: Eye, seen: EyeRadiance
) -> tuple[FeatureView, ...]:
    """Labels of all markers in the drogue's order.

    Args:
        frame: for rig, sensor and exposure.
        layout: of the drogue.
        pose: `left_from_drogue` at mid-exposure.
        eye: which image.
        seen: its radiance and passes.
    """
    radii = np.full(layout.count, layout.radius_m)
    ellipse = disc_image_centers(frame.rig, pose, layout.centers_m, radii, eye)
    proj = frame.rig.image(pose.apply(layout.centers_m), eye)
    return tuple(
        _feature_view(frame, disc, seen, proj[index], ellipse[index])
        for index, disc in enumerate(marker_discs(layout, frame.rig, pose, eye))
    )


def hub_view(
    frame: FrameSpec, layout: MarkerLayout, pose: RigidTransform, eye: Eye, seen: EyeRadiance
) -> HubView | None:
    """Labels of the hub annulus, each edge with its own radius; None without a hub. Arguments as `marker_views`."""
    discs = hub_discs(layout, frame.rig, pose, eye)
    if discs is None or layout.hub_center_m is None:
        return None
    center = layout.hub_center_m[None]
    outer, inner = (disc_image_centers(frame.rig, pose, center, np.array([disc.radius_m]), eye)[0] for disc in discs)
    view = _feature_view(frame, discs[0], seen, frame.rig.image(pose.apply(center), eye)[0], outer)
    return HubView(**view.model_dump(), center_ellipse_inner_px=_point(inner))


def visible_fraction(part: int, seen: EyeRadiance) -> float:
    """Visible over amodal pixel centres of a feature; 0 where it covers none.

    `labelgen.validation.label_checks` faults passes in which a feature has more visible pixels than amodal ones.
    """
    amodal = seen.amodal_px.get(part, 0)
    return min(1.0, int(np.count_nonzero(seen.part_id == part)) / amodal) if amodal else 0.0


def _feature_view(frame: FrameSpec, disc: DiscInEye, seen: EyeRadiance, proj: Array, ellipse: Array) -> FeatureView:
    u_low, v_low, u_high, v_high = disc.extent_px()
    return FeatureView(
        center_proj_px=_point(proj),
        center_ellipse_px=_point(ellipse),
        visible_fraction=visible_fraction(disc.part, seen),
        in_image=not is_truncated((u_low, v_low, u_high - u_low, v_high - v_low), disc.camera),
        signal_to_noise=signal_to_noise(frame, disc, seen),
    )


def signal_to_noise(frame: FrameSpec, disc: DiscInEye, seen: EyeRadiance) -> float:
    """Contrast of a feature against the dark parts around it, over shot and read noise at their mean level.

    Of the sensor's channels the one with the highest ratio. Computed for a perfect lens, before noise and rounding; 0
    for a feature without visible pixels.
    """
    window = window_around(disc, _SURROUNDINGS_REACH)
    if window is None:
        return 0.0
    part_id = seen.part_id[window.rows, window.columns]
    feature = part_id == disc.part
    near = (disc.distance_m(window.pixels_px) < _SURROUNDINGS_REACH * disc.radius_m) & ~feature
    dark = near & _is_structure(part_id)
    around = dark if dark.any() else near
    if not feature.any() or not around.any():
        return 0.0
    electrons = _electrons(frame, seen.radiance_cd_m2[window.rows, window.columns])
    signal_e, around_e = electrons[feature].mean(axis=0), electrons[around].mean(axis=0)
    noise_e = np.sqrt((signal_e + around_e) / 2 + frame.sensor.read_noise_e**2)
    # A sensor without read noise in perfect darkness has no noise, and no contrast either.
    return float((np.abs(signal_e - around_e) / np.maximum(noise_e, 1e-12)).max())


def _electrons(frame: FrameSpec, radiance_cd_m2: NDArray[np.float32]) -> Array:
    """(..., C) mean electrons of the sensor's channels, at most a full well or what the gain takes to white."""
    light = radiance_cd_m2.astype(np.float64)
    if frame.band_nm is not None:
        light = infrared_light(light, frame.band_nm)[..., None]
    elif frame.is_monochrome:
        light = light @ mono_weights(None).T
    most_e = frame.sensor.full_well_e / max(frame.exposure.gain, 1.0)
    electrons: Array = np.clip(light * frame.sensor.electrons_per_cd_m2(frame.exposure), 0.0, most_e)
    return electrons


def _is_structure(part_id: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether pixels see a part of the drogue other than markers and hub."""
    is_marker = (part_id >= FIRST_MARKER_ID) & (part_id < FIRST_MARKER_ID + MAX_MARKERS)
    own = part_id < INSTANCE_STEP
    others: NDArray[np.bool_] = own & ~is_marker & ~np.isin(part_id, (Part.SKY, Part.HUB, *SURROUNDING_PARTS))
    return others


def _point(pixel: Array) -> tuple[float, float]:
    return float(pixel[0]), float(pixel[1])
