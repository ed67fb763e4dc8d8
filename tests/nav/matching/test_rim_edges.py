"""The rim's edge in pictures that OpenCV draws."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES, paper_rig
from nav.matching.rim_edges import measure_rim
from nav.pose.pose_method import RimEdges

RIG = paper_rig()
FINE, SIZE_PX, NOISE_DN = 8, 160, 1.5
SKY_DN = 150.0
CENTER_PX, AXES_PX, TURN_DEG = np.array([82.3, 77.6]), np.array([46.0, 43.5]), 25.0


def draw(rim_dn: float = 12.0, axes_px: np.ndarray = AXES_PX) -> np.ndarray:
    """Light of a rim with spokes, a face's opening, and a bright sky, on a grid that is eight times as fine."""
    fine = np.full((SIZE_PX * FINE,) * 2, SKY_DN, np.float32)
    # The centre of pixel (0, 0) is (FINE - 1) / 2 on the fine grid.
    center = tuple(np.rint(((CENTER_PX + 0.5) * FINE - 0.5) * 16).astype(int).tolist())

    def fill(scale: float, level: float) -> None:
        axes = tuple(np.rint(scale * axes_px * FINE * 16).astype(int).tolist())
        cv2.ellipse(fine, center, axes, TURN_DEG, 0, 360, level, -1, cv2.LINE_8, 4)

    fill(1.0, rim_dn)
    fill(0.8, 0.9 * SKY_DN)
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        end = CENTER_PX + 0.9 * AXES_PX.min() * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple((np.rint((place + 0.5) * FINE).astype(int)).tolist()) for place in (CENTER_PX, end)]
        cv2.line(fine, *ends, rim_dn, 2 * FINE)
    return fine


def pair_of(fine: np.ndarray, seed: int = 0) -> StereoImages:
    """The same picture for both eyes, with the lens's blur and noise of its own in each."""
    sharp = cv2.resize(fine, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(sharp, (0, 0), 0.5)
    rng = np.random.default_rng(seed)
    eyes = [np.clip(np.rint(smooth + rng.normal(0, NOISE_DN, smooth.shape)), 0, 255).astype(np.uint8) for _ in EYES]
    return StereoImages(*eyes, encoding="linear", bits=8, black_level_dn=0.0, time_s=0.0, exposure_s=1e-3)


def measure(images: StereoImages, off: float = 0.0) -> RimEdges:
    size = 2 * 46.0 * (1 + off)
    box = (*(CENTER_PX - size / 2 + off * 20), size, size)
    return measure_rim(images, RIG, dict.fromkeys(EYES, box), 0.04)


def distances_px(edges: RimEdges) -> np.ndarray:
    """Signed distances of the points outside of the drawn ellipse, to first order."""
    turn = np.radians(TURN_DEG)
    own = (edges.points_px - CENTER_PX) @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    radius = np.linalg.norm(own / AXES_PX, axis=1)
    slope = np.linalg.norm(own / AXES_PX**2, axis=1) / radius
    return (radius - 1) / slope


@pytest.mark.parametrize("off", [-0.1, 0.0, 0.1])
def test_edges_lie_on_the_drawn_ellipse_with_the_stated_deviations(off: float) -> None:
    edges = measure(pair_of(draw()), off)
    distance = distances_px(edges)
    assert edges.seen_fraction == (1.0, 1.0)
    # The fine grid's steps of an eighth of a pixel leave a hundredth in the mean.
    assert abs(distance.mean()) < 0.02
    assert abs((distance * np.sign(edges.normals[:, 0])).mean()) < 0.01
    # The deviation of 90 points is known to 8 %; thrice that, and what the grid adds.
    assert 0.75 < distance.std() / np.sqrt((edges.sigma_px**2).mean()) < 1.4
    assert np.linalg.norm(edges.normals, axis=1) == pytest.approx(1)
    assert min(edges.darkness) > 0.85


def test_deviations_of_faint_edges_grow_and_hold() -> None:
    sharp, faint = (measure(pair_of(SKY_DN - share * (SKY_DN - draw()))) for share in (1.0, 0.12))
    # The noise is the same, and the contrast an eighth. Part of a sharp edge's deviation is the light that may lie on
    # the tube's flank, which is a share of the contrast.
    assert np.median(faint.sigma_px) > 3 * np.median(sharp.sigma_px)
    assert 0.75 < distances_px(faint).std() / np.sqrt((faint.sigma_px**2).mean()) < 1.4


def test_a_sky_of_two_halves_and_a_hose_move_no_edge() -> None:
    fine = draw()
    rim = fine < 13
    fine[:, : 82 * FINE][~rim[:, : 82 * FINE]] *= 0.5
    cv2.line(fine, (0, 0), (60 * FINE, 50 * FINE), 20.0, 6 * FINE)
    edges = measure(pair_of(fine))
    distance = distances_px(edges)
    # A common shift of a tenth of a pixel has its prior in the pose; all edges share it.
    assert abs(np.median(distance)) < 0.15
    assert np.median(np.abs(distance - np.median(distance))) < 0.05
    assert min(edges.seen_fraction) > 0.8


def test_what_is_hidden_or_clipped_is_not_seen() -> None:
    fine = draw()
    fine[: 70 * FINE] = 60.0
    hidden = measure(pair_of(fine))
    assert max(hidden.seen_fraction) < 0.7
    # A sky beyond the sensor's range tells nothing about where the edge is.
    assert measure(pair_of(2 * draw())).seen_fraction == (0.0, 0.0)


def test_a_lit_rim_is_told_by_its_darkness() -> None:
    edges = measure(pair_of(draw(rim_dn=70.0)))
    assert edges.darkness == pytest.approx((1 - 70 / SKY_DN,) * 2, abs=0.1)


def test_no_rim_gives_no_points() -> None:
    assert len(measure(pair_of(np.full((SIZE_PX * FINE,) * 2, 90, np.float32))).points_px) == 0
    tiny = measure_rim(pair_of(draw()), RIG, {"left": (80.0, 80.0, 9.0, 9.0)}, 0.04)
    assert tiny.seen_fraction == (0.0, 0.0)
    outside = measure_rim(pair_of(draw()), RIG, {"left": (-300.0, 10.0, 90.0, 90.0)}, 0.04)
    assert len(outside.eyes) == 0


@pytest.mark.parametrize("cut_px", [40, 55, 70])
def test_a_rim_across_the_images_edge_has_the_rest_of_its_edge(cut_px: int) -> None:
    whole = pair_of(draw())
    cut = StereoImages(*(np.ascontiguousarray(eye[:, cut_px:]) for eye in (whole.left, whole.right)), 0.0, 1e-3)
    center = CENTER_PX - (cut_px, 0)
    edges = measure_rim(cut, RIG, dict.fromkeys(EYES, (*(center - 46), 92.0, 92.0)), 0.04)
    assert 0.3 < min(edges.seen_fraction) <= max(edges.seen_fraction) < 1
    moved = replace(edges, points_px=edges.points_px + np.array([cut_px, 0]))
    # Another circle, as the face's opening, is brighter inside and so has no pose.
    assert np.median(np.abs(distances_px(moved))) < 0.15 or max(edges.darkness) < 0


@pytest.mark.parametrize("seed", range(6))
def test_pictures_of_anything_have_edges_with_numbers_or_none(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = np.full((SIZE_PX, SIZE_PX), rng.integers(0, 256), np.uint8)
    for _ in range(12):
        center, axes = rng.integers(20, 140, 2).tolist(), rng.integers(5, 60, 2).tolist()
        cv2.ellipse(image, center, axes, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(0, 256)), -1)
    images = StereoImages(image, image[:, ::-1].copy(), time_s=0.0, exposure_s=1e-3)
    edges = measure_rim(images, RIG, {"left": (40.0, 40.0, 80.0, 80.0), "right": (-20.0, 90.0, 75.0, 85.0)}, 0.02)
    for numbers in (edges.points_px, edges.normals, edges.sigma_px, edges.darkness):
        assert np.isfinite(numbers).all()
    assert (edges.sigma_px > 0).all()


def test_the_inner_edge_of_the_face_is_not_taken_for_the_rim() -> None:
    # The box is a seventh too small; the opening at 0.8 of the radius is nearer to it than the rim is.
    edges = measure(pair_of(draw()), -0.12)
    assert np.median(np.abs(distances_px(edges))) < 0.1
