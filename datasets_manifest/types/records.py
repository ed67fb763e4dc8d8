"""The truth of one stereo pair, as stored on disk: a function of the recipe and the frame alone."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from datasets_manifest.types.field_types import Transform
from datasets_manifest.types.frame import FrameSpec
from drogue_models.frozen_model import FrozenModel
from drogue_models.parts import MAX_MARKERS

MOST_TIME_S = 2.0**31
"""Times of records stay below it, as the stamps of robots and of exports have seconds of 32 bits. [s]"""
PixelPoint = tuple[float, float]
PixelBox = tuple[float, float, float, float]
"""x, y of the low corner, width, height, in pixel-centre coordinates: a full frame is (-0.5, -0.5, W, H)."""


class FeatureView(FrozenModel):
    """Labels of one marker, or of the hub, in one image.

    Attributes:
        center_proj_px: image of the 3-D centre.
        center_ellipse_px: centre of the image ellipse, the reference for centroids.
        visible_fraction: visible over amodal pixel centres on the image's grid; 1 unoccluded, 0 outside the image.
        in_image: whether the whole feature lies on the image.
        signal_to_noise: contrast against its background over the sensor's noise at one pixel.
    """

    center_proj_px: PixelPoint
    center_ellipse_px: PixelPoint
    visible_fraction: float = Field(ge=0, le=1)
    in_image: bool
    signal_to_noise: float


class HubView(FeatureView):
    """The hub annulus: `center_ellipse_px` belongs to its outer edge."""

    center_ellipse_inner_px: PixelPoint


class NeighbourView(FrozenModel):
    """Boxes of a drogue that is not sought, in one image.

    Attributes:
        box_full_xywh_px, box_visible_xywh_px, visible_drogue_px, truncated: as in `ViewRecord`.
    """

    box_full_xywh_px: PixelBox
    box_visible_xywh_px: PixelBox | None
    visible_drogue_px: int = Field(ge=0)
    truncated: bool


class ViewRecord(FrozenModel):
    """Truth of one eye.

    Attributes:
        markers: in the drogue's order.
        hub: None when the drogue has none.
        box_full_xywh_px: of the whole drogue, neither clipped nor occluded; None in an empty frame.
        box_visible_xywh_px: around its visible pixels; None when no pixel is visible.
        visible_drogue_px: number of pixel centres that see the drogue.
        truncated: the full box leaves the image.
        neighbours: in the order of the frame's `neighbours`.
        board_corners_px: images of a calibration board's inner corners, row by row; only in frames with a board.
    """

    markers: tuple[FeatureView, ...] = Field(max_length=MAX_MARKERS)
    hub: HubView | None
    box_full_xywh_px: PixelBox | None
    box_visible_xywh_px: PixelBox | None
    visible_drogue_px: int = Field(ge=0)
    truncated: bool
    neighbours: tuple[NeighbourView, ...] = Field(default=(), exclude_if=lambda neighbours: not neighbours)
    board_corners_px: tuple[PixelPoint, ...] = Field(default=(), exclude_if=lambda corners: not corners)


class StereoViews(FrozenModel):
    """Both eyes."""

    left: ViewRecord
    right: ViewRecord


class Conditions(FrozenModel):
    """Conditions by which reports group frames.

    Attributes:
        sun_elevation_deg: of the scene's sun; None where an environment map shows none. [deg]
        markers_in_view, hub_in_view: of a sequence's pair, by eye: number of markers wholly inside the image, and
            whether the hub is, regardless of occlusion.
    """

    family: str
    distance_m: float | None
    sun_elevation_deg: float | None
    background_luminance_cd_m2: float
    monte_carlo_noise_fraction: float
    monte_carlo_over_sensor_noise: float | None = None
    markers_in_view: tuple[int, int] | None = Field(default=None, exclude_if=lambda count: count is None)
    hub_in_view: tuple[bool, bool] | None = Field(default=None, exclude_if=lambda seen: seen is None)


class PairRecord(FrozenModel):
    """All labels of one stereo pair.

    Attributes:
        frame_index: in the dataset.
        scene_id: of the drawn environment.
        sequence_id: None for a single pair.
        time_s: mid-exposure. [s]
        left_from_drogue: at mid-exposure; None in an empty frame.
        left_from_drogue_open: when the shutter opens.
        left_from_drogue_close: when the shutter closes.
        pitch_deg: of `left_from_drogue`.
        yaw_deg: of `left_from_drogue`.
        roll_deg: of `left_from_drogue`.
        roll_modulo_deg: roll modulo the markers' symmetry, in [0, 360/order).
        views: labels of both images.
        conditions: by which reports group pairs.
        file_sha256: of every other file of the frame, by name.
        engine: renderer of the radiance.
        engine_version: of the renderer.
        image_black_level_dn: pixel value of the stored images without light. [DN]
        frame: the specification that it was made from.
    """

    schema_version: Literal[1] = 1
    frame_index: int = Field(ge=0)
    scene_id: int = Field(ge=0)
    sequence_id: int | None
    time_s: float = Field(gt=-MOST_TIME_S, lt=MOST_TIME_S)
    left_from_drogue: Transform | None
    left_from_drogue_open: Transform | None
    left_from_drogue_close: Transform | None
    pitch_deg: float | None
    yaw_deg: float | None
    roll_deg: float | None
    roll_modulo_deg: float | None
    views: StereoViews
    conditions: Conditions
    engine: str
    engine_version: str
    image_black_level_dn: float = Field(default=0.0, ge=0)
    file_sha256: dict[str, str]
    frame: FrameSpec
