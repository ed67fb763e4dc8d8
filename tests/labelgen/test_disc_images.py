from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from geometry.circles import disc_area_px2, disc_outline
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, Eye, paper_rig
from labelgen.disc_images import hub_discs, marker_discs, window_around

LAYOUT = marker_layout(PRESETS["red-8"])
RIG = paper_rig()


@st.composite
def poses(draw: st.DrawFn) -> RigidTransform:
    angles = [draw(st.floats(-0.5, 0.5)), draw(st.floats(-0.5, 0.5)), draw(st.floats(-3, 3))]
    distance_m = draw(st.floats(1.7, 40))
    place = [draw(st.floats(-0.2, 0.2)) * distance_m, draw(st.floats(-0.15, 0.15)) * distance_m, distance_m]
    return RigidTransform(rotation_from_angles(*angles), np.array(place))


@given(poses(), st.sampled_from(EYES), st.integers(0, 7))
def test_extent_holds_the_projected_outline_and_touches_it(pose: RigidTransform, eye: Eye, index: int) -> None:
    disc = marker_discs(LAYOUT, RIG, pose, eye)[index]
    outline = RIG.project(disc_outline(pose, LAYOUT.centers_m[index], LAYOUT.radius_m, 4096), eye)
    low, high = np.array(disc.extent_px()[:2]), np.array(disc.extent_px()[2:])
    assert (outline >= low - 1e-9).all() and (outline <= high + 1e-9).all()
    # Between two of 4096 points the outline rises by at most a (1 - cos(pi / 4096)) < 3e-7 a, with a < 100 px.
    np.testing.assert_allclose(outline.min(axis=0), low, atol=3e-5)
    np.testing.assert_allclose(outline.max(axis=0), high, atol=3e-5)


@given(poses(), st.sampled_from(EYES))
def test_semi_axes_give_the_area(pose: RigidTransform, eye: Eye) -> None:
    disc = marker_discs(LAYOUT, RIG, pose, eye)[3]
    longer, shorter = disc.semi_axes_px()
    assert longer >= shorter > 0
    want = disc_area_px2(RIG, pose, LAYOUT.centers_m[3], LAYOUT.radius_m, eye)
    # The shape is a difference of numbers of 1e6 px^2 that leaves a few px^2.
    assert np.pi * longer * shorter == pytest.approx(want, rel=1e-6)


@given(poses(), st.sampled_from(EYES))
def test_rays_through_projected_points_meet_the_plane_in_them(pose: RigidTransform, eye: Eye) -> None:
    outer, inner = hub_discs(LAYOUT, RIG, pose, eye)
    for disc in (outer, inner):
        edge_m = disc_outline(pose, LAYOUT.hub_center_m, disc.radius_m, 12)
        pixels = RIG.project(edge_m, eye)
        np.testing.assert_allclose(disc.distance_m(pixels), disc.radius_m, rtol=1e-9)
        np.testing.assert_allclose(disc.plane_depth_m(pixels), edge_m[:, 2], rtol=1e-12)


def test_windows_end_with_the_image() -> None:
    facing = RigidTransform(np.eye(3), np.array([0.06, 0.0, 3.0]))
    disc = marker_discs(LAYOUT, RIG, facing, "left")[0]
    window = window_around(disc, 1.0)
    low_u, low_v, high_u, high_v = disc.extent_px()
    assert window.rows.start == np.ceil(low_v) and window.rows.stop == np.floor(high_v) + 1
    assert window.columns.start == np.ceil(low_u) and window.columns.stop == np.floor(high_u) + 1
    assert window.pixels_px.shape == (
        window.rows.stop - window.rows.start,
        window.columns.stop - window.columns.start,
        2,
    )
    np.testing.assert_array_equal(window.pixels_px[0, 0], [window.columns.start, window.rows.start])
    outside = RigidTransform(np.eye(3), np.array([5.0, 0.0, 3.0]))
    assert window_around(marker_discs(LAYOUT, RIG, outside, "left")[0], 1.0) is None
    at_edge = RigidTransform(np.eye(3), np.array([0.0, 479.5 / 2133.333 * 3.0 - 0.27, 3.0]))
    cut = window_around(marker_discs(LAYOUT, RIG, at_edge, "left")[0], 1.0)
    assert cut.rows.stop == 960
