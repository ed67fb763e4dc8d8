"""Boxes around a rim against closed forms, and overlaps of boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.distortion import BrownConrady, Lens
from geometry.se3 import RigidTransform
from geometry.stereo import paper_rig
from nav.tracking.region import rim_boxes

RIG = paper_rig()
CAMERA = RIG.camera
RIM_RADIUS_M = 0.3


def facing(x_m: float, z_m: float) -> RigidTransform:
    """A drogue that faces the left eye's image plane."""
    return RigidTransform(np.eye(3), np.array([x_m, 0.0, z_m]))


def x_at(edge_px: float, z_m: float) -> float:
    """Where something stands that the left eye sees in a column. [m]"""
    return (edge_px - CAMERA.cx_px) / CAMERA.fx_px * z_m


def test_a_rim_that_faces_the_camera_has_a_square_box() -> None:
    found = rim_boxes(RIG, RIM_RADIUS_M, facing(0.06, 8.0))
    radius_px = CAMERA.fx_px * RIM_RADIUS_M / 8.0
    for eye, eye_x_m in (("left", 0.0), ("right", RIG.baseline_m)):
        middle = CAMERA.cx_px + CAMERA.fx_px * (0.06 - eye_x_m) / 8.0, CAMERA.cy_px
        want = (middle[0] - radius_px, middle[1] - radius_px, 2 * radius_px, 2 * radius_px)
        # Rounding: four of the outline's points lie where the circle meets its box.
        assert found.of(eye).box_xywh_px == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize(("beyond_px", "is_seen"), [(-1.0, True), (1.0, False)])
def test_a_rim_of_which_less_than_half_is_in_the_image_has_no_box(beyond_px: float, is_seen: bool) -> None:
    # The right eye sees it further left.
    found = rim_boxes(RIG, RIM_RADIUS_M, facing(x_at(CAMERA.width_px - 0.5 + beyond_px, 8.0), 8.0))
    assert (found.left is not None) is is_seen
    assert found.right is not None


@pytest.mark.parametrize("place", [facing(0.0, -8.0), facing(0.0, 0.0), facing(0.0, 5000.0)])
def test_a_rim_behind_the_eyes_or_too_far_away_has_no_box(place: RigidTransform) -> None:
    found = rim_boxes(RIG, RIM_RADIUS_M, place)
    assert (found.left, found.right) == (None, None)


def test_a_rim_where_the_lens_polynomial_overflows_has_no_box() -> None:
    lens = Lens(CAMERA, BrownConrady(k1=0.1, k3=0.1))
    rig = replace(RIG, lenses=(lens, lens))
    with np.errstate(over="ignore", invalid="ignore"):
        found = rim_boxes(rig, RIM_RADIUS_M, facing(1e60, 1.0))
    assert (found.left, found.right) == (None, None)
