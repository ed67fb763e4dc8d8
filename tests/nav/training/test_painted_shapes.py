from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from nav.training.painted_shapes import _sample_nested_discs, paint_distractors, paint_occluders, paint_ring

BOX = np.array([[60.0, 40.0, 50.0, 36.0]])


def white_ellipse() -> np.ndarray:
    """White where a pixel's centre lies in the ellipse."""
    rows, columns = np.mgrid[:120, :160] + 0.5
    inside = ((columns - 85) / 25) ** 2 + ((rows - 58) / 18) ** 2 <= 1
    return np.repeat(np.where(inside, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def test_occluded_boxes_bound_the_visible_part() -> None:
    changed = 0
    for seed in range(400):
        image = white_ellipse()
        before = image.copy()
        (box,) = paint_occluders(np.random.default_rng(seed), image, BOX)
        if (image == before).all():
            np.testing.assert_array_equal(box, BOX[0])
            continue
        changed += 1
        left = (image == 255).all(axis=2)
        # No more than 45 % may be hidden; the rest of the tolerance is the edge's pixels.
        assert left.sum() > 0.53 * (before == 255).all(axis=2).sum()
        rows, columns = np.flatnonzero(left.any(axis=1)), np.flatnonzero(left.any(axis=0))
        seen = [columns[0], rows[0], columns[-1] + 1 - columns[0], rows[-1] + 1 - rows[0]]
        # An edge that was not touched lies where the ellipse ends, within the pixel beyond the last that it covers.
        np.testing.assert_allclose([*box[:2], *(box[:2] + box[2:])], [*seen[:2], *np.add(seen[:2], seen[2:])], atol=1)
    assert changed > 10


def test_no_drogue_disappears_behind_the_occluder_of_another() -> None:
    large, small = [10.0, 20.0, 90.0, 80.0], [104.0, 52.0, 14.0, 14.0]
    rows, columns = np.mgrid[:120, :160] + 0.5
    covered = 0
    for seed in range(600):
        image = np.full((120, 160, 3), 255, np.uint8)
        boxes = paint_occluders(np.random.default_rng(seed), image, np.array([large, small]))
        assert boxes.shape == (2, 4)
        left = (image == 255).all(axis=2)
        for box, (x, y, width, height) in zip(boxes, (large, small), strict=True):
            radii = (columns - x - width / 2) / (width / 2), (rows - y - height / 2) / (height / 2)
            ellipse = radii[0] ** 2 + radii[1] ** 2 <= 1
            visible = ellipse & left
            assert visible.sum() >= 0.55 * ellipse.sum()
            at = np.argwhere(visible)[:, ::-1] + 0.5
            # Everything visible lies in the box, whose sides are at most a pixel away from it.
            assert (at > box[:2]).all() and (at < box[:2] + box[2:]).all()
            np.testing.assert_allclose([at.min(axis=0), at.max(axis=0)], [box[:2], box[:2] + box[2:]], atol=1.5)
        covered += bool((boxes[1] != small).any())
    assert covered > 10


def test_distractors_never_touch_a_drogue() -> None:
    painted = 0
    for seed in range(300):
        image = white_ellipse()
        paint_distractors(np.random.default_rng(seed), image, BOX)
        assert (image[40:76, 60:110] == white_ellipse()[40:76, 60:110]).all()
        painted += (image != white_ellipse()).any()
    assert painted > 30


def test_nested_discs_lie_within_each_other() -> None:
    for seed in range(100):
        rng = np.random.default_rng(seed)
        discs = _sample_nested_discs(rng, np.array([100.0, 100.0]), np.array([60.0, 30.0]))
        assert len(discs) >= 2
        turn = np.linspace(0, 2 * np.pi, 60)
        for outer, inner in pairwise(discs):
            edge = inner.center_px + np.column_stack([np.cos(turn), np.sin(turn)]) * inner.half_axes_px
            assert (((edge - outer.center_px) / outer.half_axes_px) ** 2).sum(axis=1).max() <= 1 + 1e-9


def paint(half_axes_px: list[float], turn_deg: float, ambient_fraction: float = 1.0) -> np.ndarray:
    image = np.zeros((200, 200, 3), np.uint8)
    lamp = np.array([0.6, 0.0, 0.8])
    axes = np.array(half_axes_px)
    paint_ring(image, np.array([100.0, 100.0]), axes, turn_deg, 8.0, (200, 100, 50), ambient_fraction, lamp)
    return image


@pytest.mark.parametrize(("turn_deg", "minor_px"), [(0, 60), (0, 40), (30, 50), (120, 45)])
def test_a_painted_ring_is_the_outline_of_a_torus(turn_deg: float, minor_px: float) -> None:
    # From afar a torus is all that lies within its tube's radius of its middle's ellipse, here as OpenCV draws it.
    image = paint([60.0, minor_px], turn_deg)
    scale = 16
    large = np.zeros((200 * scale, 200 * scale), np.uint8)
    angles = np.linspace(0, 2 * np.pi, 2000)
    along, across = 60 * np.cos(angles), minor_px * np.sin(angles)
    turn = np.radians(turn_deg)
    middle = np.stack([along * np.cos(turn) - across * np.sin(turn), along * np.sin(turn) + across * np.cos(turn)], 1)
    cv2.polylines(large, [np.rint((middle + 100) * scale).astype(np.int32)], True, 255, thickness=16 * scale)
    coverage = cv2.resize(large, (200, 200), interpolation=cv2.INTER_AREA) / 255
    # A ramp of one pixel for an edge is off by 0.1 where it runs askew, and the painted edge, exact on both axes of the
    # ellipse, by a fifth of a pixel between them. Over the image that is the mean: the edges pass 3 % of its pixels.
    difference = np.abs(image[..., 0] / 200 - coverage)
    assert difference.max() < 0.3 and difference.mean() < 0.03 * 0.1
    assert image[100, 100].max() == 0


def test_a_painted_ring_is_lit_from_one_side() -> None:
    image = paint([60.0, 60.0], 0, ambient_fraction=0.3).astype(float)
    # Normals there: 0.5 of the tube's radius outwards, to the right and to the left of the ring's right part.
    outer, inner = image[100, 163].mean(), image[100, 155].mean()
    normal = np.array([0.4375, 0, np.sqrt(1 - 0.4375**2)])  # the middle of pixel 163 is 3.5 px beyond the tube's middle
    expected = np.mean([200, 100, 50]) * (0.3 + 0.7 * normal @ [0.6, 0.0, 0.8])
    assert outer == pytest.approx(expected, abs=1)
    assert inner < outer - 10
    np.testing.assert_allclose(image[..., 1], image[..., 0] / 2, atol=1)


def test_rings_are_clipped_at_the_edge() -> None:
    whole, cut = np.zeros((200, 200, 3), np.uint8), np.zeros((100, 100, 3), np.uint8)
    for image in (whole, cut):
        lamp = np.array([0.0, 0.0, 1.0])
        paint_ring(image, np.array([95.0, 90.0]), np.array([40.0, 30.0]), 20, 6.0, (200, 30, 30), 0.5, lamp)
    np.testing.assert_array_equal(cut, whole[:100, :100])
    paint_ring(cut, np.array([-300.0, 50.0]), np.array([40.0, 30.0]), 20, 6.0, (9, 9, 9), 0.5, lamp)
    np.testing.assert_array_equal(cut, whole[:100, :100])
