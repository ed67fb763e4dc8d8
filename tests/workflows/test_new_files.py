"""Files that `droguekit new` writes are read back with the numbers that were asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.recipe.rigs import SENSORS, load_rig, resolve_rig
from droguekit.cli.main import DONE, WRONG_INPUT, run
from tests.support.stereo_calibrations import EVERYTHING, INTRINSICS, POSE, R1, check_rig, storage


def test_a_recipe_of_a_new_drogue_and_a_new_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drogue = ["--markers", "12", "--marker-radius", "0.01", "--luminance", "20000", "--rim-radius", "0.305"]
    rig = ["--size", "1920x1200", "--focal-px", "1739.13", "--baseline", "0.25", "--bits", "12"]
    recipe = ["--drogue", "basket.toml", "--rig", "acme-rig.toml", "--distance", "5:60", "--pairs", "20"]
    for kind, out, options in (("drogue", "basket", drogue), ("rig", "acme-rig", rig), ("recipe", "acme", recipe)):
        assert run(["new", kind, "--out", f"{out}.toml", *options]) == DONE
        assert f"`{out}.toml`" in (text := Path(f"{out}.toml").read_text()) or f"{out}.toml" in text
    read = load_recipe("acme.toml").recipe
    assert (read.drogue.marker_count, read.drogue.marker_radius_m, read.drogue.rim_radius_m) == (12, 0.01, 0.305)
    assert read.drogue.marker_luminance_cd_m2 == 20000
    assert (read.rig.camera.width_px, read.rig.camera.height_px, read.rig.baseline_m) == (1920, 1200, 0.25)
    assert np.isclose(read.rig.camera.fx_px, 1739.13)
    assert read.sensor.output_bits == 12
    assert (read.distance.low_m, read.distance.high_m, read.frames.count) == (5, 60, 20)


@pytest.mark.parametrize("preset", SENSORS)
def test_a_new_rig_is_the_preset(preset: str, tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    assert run(["new", "rig", "--preset", preset, "--focal-px", "2133.333333333333", "--out", str(out)]) == DONE
    rig, sensor = resolve_rig(load_rig(str(out)))
    wanted_rig, wanted_sensor = resolve_rig(preset)
    assert sensor == wanted_sensor
    assert (rig.baseline_m, rig.camera.width_px, rig.camera.cy_px) == (0.12, 1280, 479.5)
    # By the digits of the focal length.
    assert rig.camera.fx_px == pytest.approx(wanted_rig.camera.fx_px, rel=1e-14)
    assert (rig.lenses is None) == (wanted_rig.lenses is None)
    for lens, wanted in zip(rig.lenses or (), wanted_rig.lenses or (), strict=True):
        assert lens.distortion == wanted.distortion
        np.testing.assert_array_equal(lens.ideal_from_real, wanted.ideal_from_real)
    ideal = "Without this table the lenses are ideal."
    assert (ideal in out.read_text()) == (wanted_rig.lenses is None)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["drogue", "--markers", "40"], "marker_count: must be a whole number from 3 to 32, got 40"),
        (["drogue", "--marker-radius", "0.1"], "new drogue:"),
        (["rig", "--size", "1920"], "--size: must be WIDTHxHEIGHT in pixels, such as 1920x1200, got '1920'"),
        (["rig", "--size", ""], "--size: must be WIDTHxHEIGHT in pixels, such as 1920x1200, got ''"),
        (["rig", "--preset", "acme"], "no rig named 'acme'; there are rgb-ideal"),
        (["rig", "--bits", "10"], "output_bits"),
        (["recipe", "--distance", "far"], "--distance: must be NEAR:FAR in metres, such as 5:60, got 'far'"),
        (["recipe", "--rig", "none.toml"], "none.toml: cannot be read"),
    ],
)
def test_numbers_that_do_not_fit_are_told_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], message: str
) -> None:
    assert run(["new", *command, "--out", str(tmp_path / "mine.toml")]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert message in told
    assert len(told.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


OPTIONS = {
    "drogue": {"--rim-radius": "0.305", "--markers": "8", "--marker-radius": "0.01", "--luminance": "0"},
    "rig": {"--preset": "nonsense", "--size": "1x1", "--focal-px": "2000", "--baseline": "0.12", "--bits": "8"},
    "recipe": {"--drogue": "nonsense", "--rig": "mono", "--distance": "5:40", "--pairs": "100"},
}


@pytest.mark.parametrize("kind", OPTIONS)
def test_an_option_of_another_kind_is_refused(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for other in OPTIONS.keys() - {kind}:
        for option, value in OPTIONS[other].items():
            assert run(["new", kind, option, value, "--out", str(tmp_path / "mine.toml")]) == WRONG_INPUT
            assert f"error: {option}: is of a {other}, and this is a {kind}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_numbers_and_names_come_back_as_they_were_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["new", "rig", "--focal-px", "1745.678912", "--size", "0640x0480", "--out", "my rig.toml"]) == DONE
    # A file is named as the command sees it, and stands in the recipe as the recipe sees it.
    assert run(["new", "recipe", "--rig", "my rig.toml", "--out", "below/Größe.toml"]) == DONE
    read = load_recipe("below/Größe.toml").recipe
    assert (read.rig.camera.width_px, read.rig.camera.fx_px, read.name) == (640, 1745.678912, "gr--e")


def test_a_new_rig_of_a_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    storage(Path("stereo.yaml"), EVERYTHING)
    assert run(["new", "rig", "--calibration", "stereo.yaml", "--out", "below/rig.toml"]) == DONE
    assert run(["new", "recipe", "--rig", "below/rig.toml", "--out", "mine.toml"]) == DONE
    check_rig(load_recipe("mine.toml").recipe.rig, R1)
    # OpenCV's samples write the size of the images nowhere.
    storage(Path("intrinsics.yml"), INTRINSICS)
    storage(Path("extrinsics.yml"), POSE)
    files = ["--calibration", "intrinsics.yml", "--calibration", "extrinsics.yml"]
    assert run(["new", "rig", *files, "--size", "1280x960", "--out", "two.toml"]) == DONE
    check_rig(resolve_rig(load_rig("two.toml"))[0], R1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--calibration", "stereo.yaml", "--focal-px", "2000"], "--focal-px: the calibration has it; leave it out"),
        (["--calibration", "stereo.yaml", "--baseline", "0.2"], "--baseline: the calibration has it; leave it out"),
        (["--calibration-unit", "mm"], "--calibration-unit: is of --calibration, which is missing"),
        (["--calibration", "nowhere.yaml"], "rig: nowhere.yaml: there is no such calibration file"),
    ],
)
def test_options_beside_a_calibration_are_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    storage(Path("stereo.yaml"), EVERYTHING)
    assert run(["new", "rig", *options, "--out", "below/rig.toml"]) == WRONG_INPUT
    assert message in capsys.readouterr().err
    assert not Path("below").exists()


@pytest.mark.parametrize("drogue", ['red-8"\nseed = 5\n#', 'a"b', "a\\b"])
def test_a_name_cannot_add_keys(drogue: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["new", "recipe", "--drogue", drogue, "--out", str(tmp_path / "mine.toml")]) == WRONG_INPUT
    assert "no preset named" in capsys.readouterr().err


def test_a_file_that_is_there_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.toml").write_text("mine")
    assert run(["new", "rig", "--out", str(tmp_path / "mine.toml")]) == WRONG_INPUT
    assert "is there already" in capsys.readouterr().err
    assert (tmp_path / "mine.toml").read_text() == "mine"


def test_a_rig_file_without_a_preset_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text("width_px = 640\n")
    assert run(["new", "recipe", "--rig", "rig.toml", "--out", str(tmp_path / "mine.toml")]) == WRONG_INPUT
    assert "rig.toml: preset: name the shipped rig to start from" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 10_000, "a." * 10_000 + "a = 1", "a = " + "1" * 5000, "# " + "x" * 2**20]
)
def test_a_hostile_rig_file_is_told(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text(text)
    assert (
        run(["new", "recipe", "--rig", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "mine.toml")]) == WRONG_INPUT
    )
    told = capsys.readouterr().err
    assert "rig.toml: " in told and told.count("\n") == 1
