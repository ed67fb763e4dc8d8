"""The whole report by an engine that needs no renderer, and a second run that resumes the first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from render.engine import load_engine
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from studies.engine_agreement.__main__ import ResultStore, main
from studies.engine_agreement.costs import CostComparison, EngineCost, cost_from_row, measure_costs
from studies.engine_agreement.paired_frames import FAMILIES, paired_frames, recipe_of_family, write_sky_recipe


def run(*arguments: str) -> Any:
    app = Typer()
    app.command()(main)
    return CliRunner().invoke(app, [*arguments, "--engines", "analytic", "analytic"])


def test_an_engine_reaches_all_bars_against_itself_and_is_not_asked_twice(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path), "--part", "frames", "--part", "plates", "--plate-samples", "1"]
    options += ["--family", "smoke", "--station", "3", "--count", "1", "--samples", "4"]
    first = run(*options)
    assert first.exit_code == 0, first.output
    tables = json.loads((tmp_path / "agreement.json").read_text())
    assert all(bar["reached"] for bar in tables["bars"]) and len(tables["plates"]) == 4
    assert tables["frames"][0]["centroid_rms_px"] == 0 and tables["frames"][0]["markers"] == 16
    picture = tmp_path / "frames" / "000.png"
    picture.unlink()
    again = run(*options)
    assert again.exit_code == 0 and json.loads((tmp_path / "agreement.json").read_text()) == tables
    # The picture comes with rendering, which was not done again.
    assert not picture.exists()
    other = run(*options, "--seed", "21")
    assert other.exit_code == 0 and picture.exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere", "no shipped recipe is named 'nowhere'"),
        ("world-89/fog", "family: recipe world-89 has none named 'fog'; there are clear, "),
        ("demo/clear", "family: recipe demo has none named 'clear'; there are none"),
    ],
)
def test_a_family_that_does_not_exist_is_named_in_one_line(tmp_path: Path, name: str, message: str) -> None:
    result = run("--out", str(tmp_path), "--part", "frames", "--family", name)
    assert result.exit_code == 2
    assert message in result.output and len(result.output.strip().splitlines()) == 1


def test_every_family_is_of_its_kind() -> None:
    frames = paired_frames(FAMILIES, [10.0], len(FAMILIES), 4, seed=1)
    wanted = [name.partition("/")[2] for name in FAMILIES]
    assert [frame.frame.family for frame in frames if "/" in frame.family] == [name for name in wanted if name]
    lit = {frame.family for frame in frames if frame.frame.drogue.marker_luminance_cd_m2 > 0}
    assert lit == {"world-89/dusk", "world-89/moonlit-night"}
    assert len({frame.frame.environment.model_dump_json() for frame in frames}) == len(FAMILIES)


def test_the_picture_of_a_sky_gives_its_sun_back(tmp_path: Path) -> None:
    drawn = environment_radiance(sample_frame(recipe_of_family("world-89/sea", 1), 0).environment)
    recipe = write_sky_recipe(tmp_path)
    (frame,) = paired_frames([str(recipe)], [10.0], 1, 4, seed=3)
    mapped = environment_radiance(frame.frame.environment)
    # One texel is 0.7 degrees; what is cut out with the sun is replaced by the sky around it.
    assert mapped.beam_direction[2] == pytest.approx(drawn.beam_direction[2], abs=0.013)
    np.testing.assert_allclose(mapped.beam_illuminance_lux, drawn.beam_illuminance_lux, rtol=0.02)
    written = (tmp_path / "sky.exr").stat().st_mtime_ns
    assert write_sky_recipe(tmp_path) == recipe and (tmp_path / "sky.exr").stat().st_mtime_ns == written


def test_findings_count_for_what_they_were_made_from_alone(tmp_path: Path) -> None:
    findings = ResultStore(tmp_path / "found")
    assert findings.get("frame", {"seed": 1}) is None
    findings.keep("frame", {"seed": 1, "tilt": (1, 2)}, {"value": 0.1})
    assert findings.get("frame", {"seed": 1, "tilt": (1, 2)}) == {"value": 0.1}
    assert findings.get("frame", {"seed": 2, "tilt": (1, 2)}) is None
    file = tmp_path / "found" / "frame.json"
    file.write_text(file.read_text()[:20])
    assert findings.get("frame", {"seed": 1, "tilt": (1, 2)}) is None


def test_an_engine_without_noise_is_never_matched_by_one_that_has_some() -> None:
    cost = CostComparison(10.0, EngineCost(16, 1.0, 0.0), EngineCost(256, 3.0, 0.10))
    assert not cost.is_reached and cost_from_row(cost.row()) == cost
    # No sampling, no noise: the fewest samples do.
    analytic = load_engine("analytic")
    same = measure_costs(40.0, 1, analytic, analytic)
    assert same.is_reached and same.other.samples == 16 and same.one.noise == same.other.noise == 0
