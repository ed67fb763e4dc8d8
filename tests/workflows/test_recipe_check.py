"""The check of a recipe against what is rendered and measured, and what it advises."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import parse_recipe
from droguekit.cli.main import DONE, WRONG_INPUT, run
from droguekit.workflows.recipe_check import RecipeCheck, check_recipe

BASKET = """name = "basket"
rim_radius_m = 0.305
face_inner_radius_m = 0.25
rim_tube_radius_m = 0.005
marker_count = {count}
marker_ring_radius_m = 0.28
marker_radius_m = {radius}
marker_luminance_cd_m2 = {luminance}
marker_emission_rgb = [1.0, 1.0, 1.0]
marker_reflectance_rgb = [{paint}, {paint}, {paint}]
"""
RECIPE = """name = "mine"
drogue = "basket.toml"
[rig]
preset = "mono"
width_px = 640
height_px = 480
focal_px = 1700.0
output_bits = {bits}
[frames]
count = 4
scenes = 1
[distance]
law = "log-uniform"
low_m = 6.0
high_m = {high}
"""


def written(folder: Path, luminance: float = 20000.0, radius: float = 0.01, **changes: object) -> Path:
    values = {"count": 12, "bits": 8, "high": 40.0, "paint": 0.8} | changes
    (folder / "basket.toml").write_text(BASKET.format(luminance=luminance, radius=radius, **values))
    (folder / "mine.toml").write_text(RECIPE.format(**values))
    return folder / "mine.toml"


def checked(file: Path) -> RecipeCheck:
    return check_recipe(parse_recipe(file.read_text(), file.parent))


def test_size_and_light_follow_the_laws_of_a_pinhole_and_a_lamp(tmp_path: Path) -> None:
    check = checked(written(tmp_path))
    for light in ("day", "dusk", "night"):
        rows = check.of_light(light)
        assert [rows[0].distance_m, rows[-1].distance_m] == [6.0, 40.0]
        assert np.allclose([row.radius_px * row.distance_m for row in rows], 17.0)
        # The depth of a ring head on is as good as its centres, and falls with the square of the distance.
        depths = [row.z_sigma_m / row.centroid_sigma_px / row.distance_m**2 for row in rows]
        assert np.allclose(depths, depths[-1], rtol=0.02)  # the ring's radius over the distance, squared
    day, dusk, night = check.lights
    assert day.sky_cd_m2 > 1000 * dusk.sky_cd_m2 > 1000 * night.sky_cd_m2
    # By night only the lamp itself shines.
    assert night.marker_cd_m2 == pytest.approx(20000.0, rel=1e-6)
    assert day.marker_cd_m2 > 20000.0


def test_sizes_and_noise_are_those_of_the_lenses(tmp_path: Path) -> None:
    """Markers behind eyes of another focal length than the ideal images look as to an ideal rig of that length."""
    text = written(tmp_path).read_text().replace("[rig]", "seed = 4\n[rig]")
    ideal = "focal_px = 1700.0\n"
    recipe = parse_recipe(text.replace(ideal, f"{ideal}eyes = {{ focal_fraction = 0.2 }}\n"), tmp_path)
    focal_px = recipe.rig.delivered_focal_px
    # At this seed.
    assert recipe.rig.camera.fx_px == 1700.0 and focal_px > 1.08 * 1700.0
    twin = parse_recipe(text.replace(ideal, f"focal_px = {focal_px!r}\n"), tmp_path)
    for row, expected in zip(check_recipe(recipe).of_light("day"), check_recipe(twin).of_light("day"), strict=True):
        for name in ("radius_px", "gap_px", "rim_px"):
            assert getattr(row, name) == pytest.approx(getattr(expected, name))
        # The meter of the wider ideal camera sees other sky, and the exposure differs by less than a percent.
        assert row.snr == pytest.approx(expected.snr, rel=0.01)
        assert row.centroid_sigma_px == pytest.approx(expected.centroid_sigma_px, rel=0.01)


def test_more_noise_a_larger_error(tmp_path: Path) -> None:
    """The error of a centre falls as the inverse of signal over noise where nothing is clipped."""
    bright, dim = (checked(written(tmp_path, luminance)).of_light("day")[-3:] for luminance in (20000.0, 5000.0))
    for one, other in zip(bright, dim, strict=True):
        assert one.snr > other.snr
        assert one.centroid_sigma_px is not None
        assert other.centroid_sigma_px is not None
        assert one.centroid_sigma_px < other.centroid_sigma_px


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"luminance": 0.0, "paint": 0.02},
            r"markers are darker than what is beside them by day from 6 m on: use lamps of [\d,]+ cd/m2 or infrared",
        ),
        (
            {"luminance": 0.0},
            r"markers are below 5 deviations of the noise at night from 6 m on: use lamps of [\d.]+ cd",
        ),
        ({"radius": 0.003}, r"markers are below 0.3 px radius from 1[0-9.]+ m on: use a radius of 0.008 m"),
        ({"count": 3}, r"3 markers leave no spare one"),
        ({"bits": 12}, r"12 bits in files of 16, which most viewers show as black"),
        ({"count": 32, "radius": 0.004, "high": 60.0}, r"neighbouring markers merge from [345][0-9.]+ m on"),
        ({"high": 200.0}, r"the rim is below 16 px from 83.2 m on"),
        ({"luminance": 300000.0}, r"lamps are brighter than the sensor's range at night up to 40 m"),
    ],
)
def test_what_will_fail_is_told_with_what_to_change(tmp_path: Path, changes: dict[str, float], message: str) -> None:
    advice = "\n".join(checked(written(tmp_path, **changes)).advice)
    assert re.search(message, advice), advice


def test_the_lamps_that_it_advises_are_enough(tmp_path: Path) -> None:
    advice = "\n".join(checked(written(tmp_path, luminance=0.0, paint=0.02)).advice)
    told = re.search(r"by day from 6 m on: use lamps of ([\d,]+) cd/m2", advice)
    assert told, advice
    luminance_cd_m2 = float(told[1].replace(",", ""))
    enough = "\n".join(checked(written(tmp_path, luminance=luminance_cd_m2, paint=0.02)).advice)
    assert "by day" not in enough
    less = "\n".join(checked(written(tmp_path, luminance=luminance_cd_m2 / 2, paint=0.02)).advice)
    assert "by day" in less


def test_markers_darker_than_the_sky_but_brighter_than_the_face_do_not_fail(tmp_path: Path) -> None:
    """Painted markers of the common kind: the sky behind the drogue is brighter, and fits still find them by day."""
    check = checked(written(tmp_path, luminance=0.0, radius=0.019, high=20.0))
    day = check.lights[0]
    assert day.face_cd_m2 < day.marker_cd_m2 < day.sky_cd_m2
    assert min(row.contrast for row in check.of_light("day")) > 0
    assert not any("by day" in sentence for sentence in check.advice)


def test_a_marker_that_noise_hides_has_no_error_of_its_centre(tmp_path: Path) -> None:
    """However large it is: nothing but its own image tells where in many pixels a marker lies."""
    night = checked(written(tmp_path, luminance=0.0, radius=0.019)).of_light("night")
    assert night[0].radius_px > 5 and max(row.snr for row in night) < 5
    assert {(row.centroid_sigma_px, row.x_sigma_m, row.z_sigma_m, row.pitch_sigma_deg) for row in night} == {
        (None,) * 4
    }


def test_the_error_of_a_large_markers_centre_falls_as_one_over_its_light(tmp_path: Path) -> None:
    """Lamps at night before the camera's noise alone: no knowledge but the image's bounds the error."""
    one, other = (checked(written(tmp_path, luminance, 0.019)).of_light("night")[0] for luminance in (0.2, 0.4))
    assert one.radius_px > 5 and one.snr > 5
    assert one.centroid_sigma_px is not None and other.centroid_sigma_px is not None
    ratio = one.centroid_sigma_px / other.centroid_sigma_px
    # The noise is that of reading, to which the lamp's own shot noise adds little.
    assert ratio == pytest.approx(other.snr / one.snr, rel=0.02) and 1.8 < ratio < 2.0


def test_empty_pairs_do_not_hide_the_markers(tmp_path: Path) -> None:
    file = written(tmp_path)
    some, page = checked(file), tmp_path / "check.html"
    file.write_text(file.read_text().replace("scenes = 1\n", "scenes = 1\nempty_fraction = 1.0\n"))
    assert checked(file) == some
    assert run(["check", str(file), "--engine", "analytic", "--html", str(page)]) == DONE
    assert page.exists()


@pytest.mark.parametrize("luminance", [0.0, 0.002])
def test_lamps_as_bright_as_advised_for_the_night_just_suffice(tmp_path: Path, luminance: float) -> None:
    """Of dark markers nothing scales to what is needed; at night that is less than a thousandth of a lamp by day."""
    advice = "\n".join(checked(written(tmp_path, luminance)).advice)
    told = re.search(r"at night from 6 m on: use (?:lamps of )?([\d.,]+) cd/m2", advice)
    assert told is not None, advice
    wanted = float(told[1].replace(",", ""))
    assert wanted < 20
    least = min(row.snr for row in checked(written(tmp_path, wanted)).of_light("night"))
    # Two figures, upwards.
    assert 5 <= least < 5 * 1.15


def test_the_command_writes_numbers_and_one_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    numbers, page = tmp_path / "check.json", tmp_path / "check.html"
    command = ["check", str(written(tmp_path)), "--engine", "analytic", "--json", str(numbers), "--html", str(page)]
    assert run(command) == DONE
    told = capsys.readouterr().out
    assert "what will fail, and what to change" in told or "nothing will fail" in told
    content = json.loads(numbers.read_text())
    assert content["schema"] == 1
    assert {row["light"] for row in content["markers"]} == {"day", "dusk", "night"}
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 9
    assert "What to expect of mine" in text
    assert "http:" not in text and "https:" not in text


def test_a_single_marker_has_no_gap(tmp_path: Path) -> None:
    recipe, numbers = written(tmp_path), tmp_path / "check.json"
    ring = "marker_count = 12\nmarker_ring_radius_m = 0.28\n"
    drogue = (tmp_path / "basket.toml").read_text()
    assert ring in drogue
    (tmp_path / "basket.toml").write_text(drogue.replace(ring, "marker_positions_m = [[0.28, 0.0]]\n"))
    assert run(["check", str(recipe), "--json", str(numbers)]) == DONE

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    content = json.loads(numbers.read_text(), parse_constant=refuse)
    assert {row["gap_px"] for row in content["markers"]} == {None}


def test_a_drogue_without_markers_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(RECIPE.format(bits=8, high=40.0).replace("basket.toml", "basket-grey"))
    assert run(["check", str(file)]) == WRONG_INPUT
    assert "the drogue basket-grey has no markers" in capsys.readouterr().err
