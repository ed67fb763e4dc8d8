"""Scores from Python, against those of the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import droguekit
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, write_estimates
from droguekit.api.stereo_dataset import StereoDataset
from droguekit.scoring.pose_benchmark import run_benchmark
from geometry.se3 import RigidTransform


def shifted(pairs: StereoDataset, shift_m: float) -> list[Estimate]:
    """The true poses, moved along the optical axis."""
    estimates: list[Estimate] = []
    for pair in pairs:
        if pair.truth is None:
            estimates.append(NoFix(frame_index=pair.frame_index, method="shifted", reason="nothing there"))
            continue
        moved = RigidTransform(pair.truth.rotation, pair.truth.translation_m + np.array([0.0, 0.0, shift_m]))
        estimates.append(PoseEstimate(frame_index=pair.frame_index, method="shifted", left_from_drogue=moved))
    return estimates


def test_estimates_score_as_their_file_does(pairs: StereoDataset, pairs_folder: Path, tmp_path: Path) -> None:
    estimates = shifted(pairs, 0.02)
    write_estimates(tmp_path / "estimates.jsonl", estimates)
    expected = run_benchmark(pairs_folder, tmp_path / "estimates.jsonl")
    assert droguekit.benchmark(pairs, estimates).result == expected
    assert droguekit.benchmark(pairs_folder, tmp_path / "estimates.jsonl").result == expected


def test_the_table_holds_the_error_that_was_made(pairs: StereoDataset) -> None:
    table = droguekit.benchmark(pairs, shifted(pairs, 0.02)).to_frame()
    overall = table[table["low_m"].isna()]
    assert list(overall["method"]) == ["shifted"]
    assert overall["position_rmse_m"].item() == pytest.approx(0.02, abs=1e-9)
    assert overall["z_bias_m"].item() == pytest.approx(0.02, abs=1e-9)
    bins = table[table["low_m"].notna()]
    assert int(bins["n"].sum()) == int(overall["n"].item())


def test_a_selection_is_scored_alone(pairs: StereoDataset) -> None:
    near = pairs.select(distance_m=(0.0, 3.5))
    assert 0 < len(near) < len(pairs.select(with_drogue=True))
    scores = droguekit.benchmark(near, shifted(pairs, 0.02))
    assert scores.result.dataset.pairs == len(near)
    assert scores.result.methods["shifted"].overall.n == len(near)


def test_the_plot_shows_the_errors(pairs: StereoDataset, tmp_path: Path) -> None:
    scores = droguekit.benchmark(pairs, shifted(pairs, 0.02))
    figure = scores.plot("z")
    (axes,) = figure.axes
    assert np.allclose(np.asarray(axes.containers[0].lines[0].get_ydata()), 20.0)
    assert axes.get_xlabel() == "Distance [m]"
    assert "shifted" in [text.get_text() for text in axes.get_legend().get_texts()]
    figure.savefig(tmp_path / "z.png")
    with pytest.raises(ValueError, match="quantity: must be one of position, x, y, z, pitch, yaw"):
        scores.plot("roll")


def test_estimates_of_unknown_pairs_are_refused(pairs: StereoDataset) -> None:
    with pytest.raises(ValueError, match="estimates: method 'm': frame 99 is not in the dataset"):
        droguekit.benchmark(pairs, [NoFix(frame_index=99, method="m", reason="none")])
