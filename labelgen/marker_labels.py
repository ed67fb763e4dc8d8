"""Labels of markers and hub in one eye."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import FeatureView, HubView
from drogue_models.marker_layout import MarkerLayout
from drogue_models.parts import FIRST_MARKER_ID, MAX_MARKERS, SURROUNDING_PARTS, Part
from geometry.circles import disc_image_centers
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye
from labelgen.boxes import leaves_image
from labelgen.discs import DiscInEye, hub_discs, marker_discs, window_around
from render.camera.sensor import MONO_WEIGHTS
from render.engine import EyeRadiance

# The surroundings that a feature stands out against reach from its edge to this multiple of its radius.
_SURROUNDINGS_REACH = 1.8


def marker_views(
    frame: FrameSpec, layout: MarkerLayout, pose: RigidTransform, eye: Eye, seen: EyeRadiance
) -> tuple[FeatureView, ...]:
    """Labels of all markers in their order.

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
        in_image=not leaves_image((u_low, v_low, u_high - u_low, v_high - v_low), disc.camera),
        signal_to_noise=signal_to_noise(frame, disc, seen),
    )


def signal_to_noise(frame: FrameSpec, disc: DiscInEye, seen: EyeRadiance) -> float:
    """Contrast of a feature against the dark parts around it, over shot and read noise at their mean level.

    Of the sensor's channels the best one counts. Numbers are those of a perfect lens, before noise and rounding; 0 for
    a feature without visible pixels.
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
    """(..., C) mean electrons of the sensor's channels, at most a full well."""
    light = radiance_cd_m2.astype(np.float64)
    if frame.sensor.color == "mono":
        light = light @ MONO_WEIGHTS.T.astype(np.float64)
    electrons: Array = np.clip(light * frame.sensor.electrons_per_cd_m2(frame.exposure), 0.0, frame.sensor.full_well_e)
    return electrons


def _is_structure(part_id: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether pixels see a part of the drogue that is no marker and no hub."""
    is_marker = (part_id >= FIRST_MARKER_ID) & (part_id < FIRST_MARKER_ID + MAX_MARKERS)
    others: NDArray[np.bool_] = ~is_marker & ~np.isin(part_id, (Part.SKY, Part.HUB, *SURROUNDING_PARTS))
    return others


def _point(pixel: Array) -> tuple[float, float]:
    return float(pixel[0]), float(pixel[1])
