"""Agreement of variants on pixels with known noise, and the study itself where no GPU is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from drogue_models.parts import Part
from studies.render_devices.__main__ import main
from studies.render_devices.variant_comparison import PairAgreement, RenderedPixels, agree, chosen_variant, compare_pair
from tests.support.recipe_builder import RIG_160_PX, recipe_text, stations

NOISE = 0.03


def pixels(seed: int, gain: float = 1.0, error: float = NOISE) -> RenderedPixels:
    """Two eyes of a face of 1000 cd/m2 with this error, which say that their noise is `NOISE`."""
    part_id = np.zeros((2, 200, 200), dtype=np.uint8)
    part_id[:, 50:150, 50:150] = Part.FACE
    luminance = np.random.default_rng(seed).normal(1000.0 * gain, 1000.0 * error, part_id.shape)
    return RenderedPixels("mitsuba", luminance.astype(np.float32), part_id, NOISE)


def test_independent_noise_is_once_the_noise() -> None:
    pair = compare_pair(pixels(1), pixels(2))
    assert pair is not None
    # 20,000 pixels: the standard error of a root mean square is 0.5 %, of the mean difference 0.03 %.
    assert pair.over_noise == pytest.approx(1.0, abs=0.02)
    assert pair.mean_difference == pytest.approx(0.0, abs=0.0012)
    assert pair.other_parts == 0.0
    assert agree([pair])


def test_a_brighter_variant_does_not_agree() -> None:
    pair = compare_pair(pixels(1), pixels(2, gain=1.02))
    assert pair is not None
    assert pair.mean_difference == pytest.approx(0.02, abs=0.0012)
    assert not agree([pair])


def test_more_noise_than_told_does_not_agree() -> None:
    pair = compare_pair(pixels(1), pixels(2, error=3 * NOISE))
    assert pair is not None
    # Errors of 1 and 3 where both tell 1: sqrt(10 / 2).
    assert pair.over_noise == pytest.approx(5**0.5, rel=0.02)
    assert not agree([pair])


def test_other_part_ids_are_counted_among_what_is_shown() -> None:
    other = pixels(2)
    other.part_id[0, 50:60, 50:150] = Part.CANOPY
    pair = compare_pair(pixels(1), other)
    assert pair is not None and pair.other_parts == pytest.approx(1000 / 20000)
    other.part_id[:] = 0
    assert compare_pair(pixels(1), other) is None


def test_pairs_agree_all_together() -> None:
    up, down = (PairAgreement(1.0, sign * 0.008, 0.0) for sign in (1, -1))
    assert agree([up, down]) and not agree([up, up])


def test_the_slow_variant_is_chosen_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/mine")
    with chosen_variant("scalar") as device:
        assert (device, os.environ["DRJIT_LIBLLVM_PATH"]) == ("cpu", "/nonexistent/libLLVM.so")
    with chosen_variant("cuda") as device:
        assert (device, os.environ["DRJIT_LIBLLVM_PATH"]) == ("cuda", "/mine")


@pytest.mark.mitsuba
def test_without_a_gpu_the_study_ends_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    assert main([]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.startswith("render_devices: error: device cuda: no NVIDIA driver")


@pytest.mark.mitsuba
@pytest.mark.slow
def test_the_two_variants_of_the_processor_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = tmp_path / "small.toml"
    recipe.write_text(recipe_text(name="small", seed=3, rig=RIG_160_PX, frames={"count": 2}, distance=stations(2.5, 4)))
    options = ["--variants", "llvm", "scalar", "--recipe", str(recipe), "--frames", "2", "--pairs", "2"]
    assert main([*options, "--workers", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert " llvm_ad_rgb, " in lines[0] and " scalar_rgb, " in lines[1]
    assert lines[5].startswith("agree within noise")
    assert [line.split(":")[0] for line in lines[6:]] == ["llvm", "scalar"]
    assert all("pairs/s with 1 workers, power not known" in line for line in lines[6:])
