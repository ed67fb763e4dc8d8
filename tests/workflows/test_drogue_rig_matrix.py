"""Twenty-four combinations of drogue and rig from recipe to benchmark: sizes, markers, sensors, lenses, baselines."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import parse_recipe
from droguekit.cli.main import DONE, run

PAIRS = 4
# The drogue is missed in a third of the pairs of these: more pairs, for as many poses as the others have.
PAIRS_OF = {3: 8, 6: 8}
SIZES = ((640, 480), (1280, 960), (1920, 1200), (4096, 3000))
SENSORS = ("mono", "paper-colour", "rgb-ideal")
COUNTS = (4, 6, 12, 24, 5, 8, 3, 16)
MARKER_RADII_M = (0.0025, 0.005, 0.01, 0.02, 0.03, 0.05)
RIM_RADII_M = (0.15, 0.25, 0.35, 0.5)
BASELINES_M = (0.05, 0.12, 0.3, 1.0)
# Focal length over the image's width: from 80 to 23 degrees of view.
FOCAL_SHARES = (0.6, 1.0, 1.6, 2.5)
RADII_PX = (1.0, 1.6, 3.0, 6.0)


@dataclass(frozen=True)
class Combination:
    """One drogue and one rig, from a number that steps through each list at a pace of its own."""

    number: int

    def pick(self, choices: tuple, pace: int) -> object:
        return choices[(self.number * pace + self.number // len(choices)) % len(choices)]

    def files(self) -> tuple[str, str]:
        """The drogue's and the recipe's TOML."""
        count, rim_m = self.pick(COUNTS, 3), self.pick(RIM_RADII_M, 1)
        marker_m = self.pick(MARKER_RADII_M, 1)
        # The markers of a small rim must fit side by side, with a margin of dark face around them.
        marker_m = min(marker_m, 0.14 * rim_m, 2.0 * rim_m / count)
        ring_m = 0.97 * rim_m - 1.4 * marker_m
        is_lamp = self.pick(SENSORS, 1) == "mono" or self.number % 2 == 0
        drogue = f"""name = "combination-{self.number}"
rim_radius_m = {rim_m}
face_inner_radius_m = {ring_m - 1.4 * marker_m:.5f}
rim_tube_radius_m = {0.012 * rim_m:.5f}
coupling_radius_m = {0.25 * rim_m:.5f}
coupling_length_m = {0.5 * rim_m:.5f}
hose_radius_m = {0.1 * rim_m:.5f}
hub = false
marker_count = {count}
marker_ring_radius_m = {ring_m:.5f}
marker_radius_m = {marker_m:.5f}
marker_luminance_cd_m2 = {12000.0 if is_lamp else 0.0}
marker_emission_rgb = {[1.0, 1.0, 1.0] if self.pick(SENSORS, 1) == "mono" else [1.0, 0.05, 0.05]}
"""
        (width, height), share = self.pick(SIZES, 1), self.pick(FOCAL_SHARES, 3)
        focal_px, baseline_m = share * width, self.pick(BASELINES_M, 1)
        nearest_m = max(2.4 * rim_m * focal_px / height, baseline_m * focal_px / width + 2.4 * rim_m * focal_px / width)
        low_m = max(focal_px * marker_m / self.pick(RADII_PX, 1), 1.3 * nearest_m)
        eyes = "[rig.eyes]\nk1 = -0.08\nk2 = 0.03\np1 = 0.0002\np2 = -0.0001\n" if self.number % 2 else ""
        recipe = f"""name = "combination-{self.number}"
drogue = "drogue.toml"
[rig]
preset = "{self.pick(SENSORS, 1)}"
width_px = {width}
height_px = {height}
focal_px = {focal_px}
baseline_m = {baseline_m}
output_bits = {8 if self.number % 3 else 12}
{eyes}[frames]
count = {PAIRS_OF.get(self.number, PAIRS)}
scenes = 1
[distance]
law = "log-uniform"
low_m = {low_m:.4f}
high_m = {1.2 * low_m:.4f}
[exposure]
auto_meter = "plate"
auto_level_fraction = 0.35
[render]
engine = "analytic"
"""
        return drogue, recipe


@pytest.mark.slow  # 24 runs of five commands, some on pairs of 12 megapixels: six minutes
@pytest.mark.parametrize("number", range(24))
def test_from_recipe_to_benchmark_without_a_fault(
    number: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drogue, recipe = Combination(number).files()
    (tmp_path / "drogue.toml").write_text(drogue)
    file, data = tmp_path / "mine.toml", tmp_path / "data"
    file.write_text(recipe)
    read = parse_recipe(recipe, tmp_path)
    assert run(["check", str(file)]) == DONE
    assert run(["render", str(file), "--out", str(data), "--workers", "0"]) == DONE
    assert run(["validate", str(data)]) == DONE
    radius_px = read.drogue.marker_radius_m * read.rig.camera.fx_px / (read.distance.high_m or 1)
    detector = "peak-ring" if radius_px < 3 and read.drogue.marker_count > 3 else "color-blob"
    estimates, numbers = tmp_path / "e.jsonl", tmp_path / "b.json"
    navigate = ["navigate", str(data), "--method", "joint", "--detector", detector, "--out", str(estimates)]
    assert run(navigate) == DONE
    assert run(["benchmark", str(data), "--estimates", str(estimates), "--json", str(numbers)]) == DONE
    row = json.loads(numbers.read_text())["methods"]["joint"]["overall"]
    ratio = row["bound_ratio"]
    pooled = None if ratio is None else float(np.sqrt(np.mean([ratio[name] ** 2 for name in ("x", "y", "z")])))
    with capsys.disabled():
        size = f"{read.rig.camera.width_px}x{read.rig.camera.height_px}"
        print(
            f"\n{number:2d} rim {read.drogue.rim_radius_m} m, {read.drogue.marker_count} of {radius_px:.2f} px, "
            f"{read.sensor.name} {read.sensor.output_bits} bit {size}, base {read.rig.baseline_m} m, {detector}: "
            f"fixes {row['fix_fraction']:.2f}, error over bound {'-' if pooled is None else f'{pooled:.2f}'}"
        )
    # The pictures of neighbours that are less than three pixels apart run into each other.
    ring_m = float(np.hypot(*read.drogue.marker_positions_m[0]))
    gap_px = radius_px / read.drogue.marker_radius_m * 2 * ring_m * np.sin(np.pi / read.drogue.marker_count)
    is_apart = gap_px - 2 * radius_px > 3
    is_measured = radius_px >= 1 and read.drogue.marker_count >= 4 and is_apart
    if is_measured and row["fix_fraction"] >= 0.5 and pooled is not None:
        # Off the optical axis the errors of a pair are one, along the line of sight: by chi-square of four, sets of
        # four pairs with a true ratio of 1 lie within 0.35 and 1.67 in 95 of 100, those of six within 0.45 and 1.55.
        # The seeds are fixed; studies/acceptance/RESULTS.md has the ratios.
        assert pooled <= 1.5
