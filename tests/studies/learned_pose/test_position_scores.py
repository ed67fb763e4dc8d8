"""Scores: the law of the error, the bound, and tables."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import load_drogue
from droguekit.api.recipe_rendering import load_recipe, render_pair
from droguekit.scoring.poses.cramer_rao import FeatureNoise, features_seen, pose_bound
from geometry.circles import project_disc_centers
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, paper_rig
from nav.pose.joint import joint
from nav.pose.pose_method import Solution
from studies.learned_pose import position_scores
from studies.learned_pose.error_plot import PLOTTED, write_error_plot
from studies.learned_pose.position_scores import (
    PairScores,
    PoseDeviation,
    in_bin,
    missing_lines,
    percentile,
    score_pose,
    stereo_bound_m,
    table_lines,
)
from studies.learned_pose.ring_keypoints import EyeKeypoints, ring_observation

RIG, LAYOUT = paper_rig(), marker_layout(load_drogue("red-8"))
DRAWS = 200


def rms_and_bound_m(distance_m: float, sigma_px: float) -> tuple[float, float]:
    """RMS position error of noisy keypoints in both eyes, and its bound. [m]"""
    true = RigidTransform(rotation_from_angles(0.12, -0.1, 0.1), np.array([0.1, 0.05, distance_m]))
    images = [project_disc_centers(RIG, true, LAYOUT.centers_m, LAYOUT.radius_m, eye) for eye in EYES]
    squares = []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        left, right = (EyeKeypoints(rng.permutation(p + rng.normal(0, sigma_px, p.shape)), sigma_px) for p in images)
        answer = joint(ring_observation(RIG, LAYOUT, (left, right)))
        assert isinstance(answer, Solution)
        squares.append(score_pose(answer.left_from_drogue, true).position_m ** 2)
    bound = pose_bound(RIG, true, LAYOUT, features_seen(LAYOUT, hub=False), FeatureNoise(sigma_px, sigma_px))
    assert bound is not None
    return float(np.sqrt(np.mean(squares))), float(np.linalg.norm(bound[:3]))


def test_the_error_of_keypoints_grows_with_the_square_of_the_distance_and_meets_the_bound() -> None:
    (near, near_bound), (far, far_bound) = (rms_and_bound_m(distance_m, 0.05) for distance_m in (3.0, 6.0))
    # The RMS of 200 draws of one dominant component errs by 1 / sqrt(400) = 5 %, a ratio by 7 %: four deviations.
    assert far / near == pytest.approx(4, rel=0.28)
    assert near / near_bound == pytest.approx(1, abs=0.2) and far / far_bound == pytest.approx(1, abs=0.2)


def rendered_record() -> PairRecord:
    rig = {"preset": "rgb-ideal", "width_px": 640, "height_px": 480, "focal_px": 1066.7}
    recipe = load_recipe(
        str(Path(__file__).parents[3] / "studies" / "learned_pose" / "test.toml"),
        rig=rig,
        render={"engine": "analytic"},
    )
    return render_pair(recipe, 0).record


def test_the_bound_is_that_of_the_markers_in_both_eyes(monkeypatch: pytest.MonkeyPatch) -> None:
    record = rendered_record()
    truth, rig = record.left_from_drogue, record.frame.rig
    assert truth is not None
    at_light = stereo_bound_m(record)
    monkeypatch.setattr(position_scores, "center_bounds_px", lambda record: np.full((2, 8), 0.25))
    expected = pose_bound(rig, truth, LAYOUT, features_seen(LAYOUT, hub=False), FeatureNoise(0.25, 0.25))
    assert expected is not None
    # The same matrix, inverted in another order.
    assert stereo_bound_m(record) == pytest.approx(float(np.linalg.norm(expected[:3])), rel=1e-6)
    # In daylight a centre can be known to some hundredths of a pixel.
    assert 0.005 / 0.25 < at_light / stereo_bound_m(record) < 0.2


def test_roll_does_not_count_and_no_pose_is_infinitely_wrong() -> None:
    truth = RigidTransform(rotation_from_angles(0.1, 0.2, 0.0), np.array([0.0, 0.0, 5.0]))
    rolled = RigidTransform(rotation_from_angles(0.1, 0.2, np.pi / 4), np.array([0.03, 0.0, 5.04]))
    score = score_pose(rolled, truth)
    assert score.position_m == pytest.approx(0.05) and score.axis_deg < 1e-5
    tilted = RigidTransform(rotation_from_angles(0.1 + np.radians(2), 0.2, 0.0), truth.translation_m)
    assert score_pose(tilted, truth).axis_deg == pytest.approx(2, abs=1e-9)
    assert score_pose(None, truth) == PoseDeviation(math.inf, math.inf)


def pairs() -> list[PairScores]:
    """Twenty pairs at 6 m and one at 25 m; `a` has errors of 1 to 20 mm, `b` misses every tenth pose."""
    near = []
    for k in range(1, 21):
        missing = PoseDeviation(math.inf, math.inf)
        scores = {"a": (PoseDeviation(0.001 * k, 0.1),), "b": (PoseDeviation(0.5, 1.0) if k % 10 else missing,)}
        near.append(PairScores(6.0, 0.002, scores))
    return [*near, PairScores(25.0, 0.01, {"a": (PoseDeviation(0.2, 0.5),), "b": (PoseDeviation(0.4, 2.0),)})]


def test_tables_have_median_and_95th_percentile() -> None:
    head, _, a, b = table_lines(pairs(), ("a", "b"), "bound")
    assert head == "| | 2 to 5 m | 5 to 10 m | 10 to 20 m | 20 to 30 m | 30 to 40 m |"
    # The 10th and the 19th of twenty.
    assert a == "| a | - | 5.00, 9.50 | - | 20.0, 20.0 | - |"
    assert b == "| b | - | 250, none | - | 40.0, 40.0 | - |"
    assert [*table_lines(pairs(), ("a",), "cm")][-1] == "| a | - | 1.00, 1.90 | - | 20.0, 20.0 | - |"
    assert [*table_lines(pairs(), ("a",), "deg")][-1] == "| a | - | 0.100, 0.100 | - | 0.500, 0.500 | - |"
    assert [*missing_lines(pairs(), ("a", "b"))] == ["a: no pose in 0 of 21", "b: no pose in 2 of 21"]


def test_missing_poses_do_not_lower_a_percentile() -> None:
    assert percentile([1.0, 2.0, math.inf, math.inf], 50) == 2.0
    assert percentile([1.0, math.inf, math.inf, math.inf], 50) == math.inf
    assert percentile([*range(1, 10), math.inf], 95) == math.inf and percentile(range(1, 11), 95) == 10


def test_bins_take_their_lower_edge() -> None:
    edge = [PairScores(distance_m, 1.0, {}) for distance_m in (4.999, 5.0, 9.999, 10.0)]
    assert [pair.distance_m for pair in in_bin(edge, 5.0, 10.0)] == [5.0, 9.999]


def test_the_plot_is_drawn_with_missing_poses(tmp_path: Path) -> None:
    two = (PoseDeviation(0.01, 0.1), PoseDeviation(math.inf, math.inf))
    some = [PairScores(z, 1e-4 * z, dict.fromkeys(PLOTTED, two)) for z in (3.0, 7.0, 15.0, 25.0, 35.0)]
    write_error_plot(some, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
