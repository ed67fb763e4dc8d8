"""The acceptance study on flights: from a recipe to the table, resumed, and what is refused."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import read_estimates, write_estimates
from droguekit.batch.progress import PlainProgress
from droguekit.cli.main import WRONG_INPUT
from nav.runner import method_names, navigate
from studies.acceptance import acceptance_table
from studies.acceptance.__main__ import (
    AcceptanceOptions,
    FlightOptions,
    measure_flight_tier,
    measure_tier,
    plan_flights,
    plan_images,
    run_command,
)
from studies.acceptance.acceptance_table import AcceptanceRow
from studies.acceptance.rendered.flight_tiers import FLIGHT_TIERS, FlightData, approach_rows, lost_rows, part_length
from studies.acceptance.rendered.scored_frames import BEST
from studies.acceptance.rendered.sequence_pairs import FILTERED, score_pairs
from tests.support.recipe_builder import RIG_320_PX, recipe_text
from tests.support.small_datasets import rendered

RECIPE = recipe_text(
    name="small-flights",
    seed=3,
    rig=RIG_320_PX,
    frames={"count": 20, "scenes": 1},
    pose={"camera_pitch_deg": 8},
    environment={"sun_elevation_deg": [30, 60], "sun_azimuth_deg": [120, 240], "clouds": {"scene_fraction": 0.0}},
    render={"engine": "analytic"},
    sequence={
        "frames_per_sequence": 20,
        "frame_rate_hz": 25,
        "release_m": [13.8, 0.5, -5],
        "receiver": {"manoeuvres": ["station"], "start_m": 3.0},
        "losses": {"kinds": ["out-of-view"], "begins_s": 0.24, "lasts_s": 0.16, "onset_s": 0.16},
    },
)

# A drogue that hangs steeply, and receivers of all attitudes: with seed 10 the second one does not look into the mouth.
TURNED = recipe_text(
    name="turned",
    rig=RIG_320_PX,
    frames={"count": 2},
    pose={"camera_pitch_deg": [-45, 45]},
    render={"engine": "analytic"},
    sequence={
        "frames_per_sequence": 2,
        "turbulence": "none",
        "release_m": [0.5, 0, -1.5],
        "hose": {"preset": "small-uav", "airspeed_m_s": 3},
        "receiver": {"manoeuvres": ["station"], "start_m": 3.0, "attitude_sd_deg": 10},
    },
)


def options(engines: tuple[str, ...] = (), **changes: object) -> AcceptanceOptions:
    return AcceptanceOptions("docking", 3, engines=engines, workers=0, flights=FlightOptions(**changes))  # type: ignore[arg-type]


def rows_of(title: str, scores: object, is_comparison: bool) -> list[AcceptanceRow]:
    return [*approach_rows(title, scores, is_comparison), *lost_rows(title, scores, is_comparison)]  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, FlightData, list[AcceptanceRow]]]:
    folder = tmp_path_factory.mktemp("bars")
    (folder / "small.toml").write_text(RECIPE)
    data = FlightData(str(folder / "small.toml"), 2, rows_of, times=True, compares=True)
    with pytest.MonkeyPatch.context() as patch:
        # Limits of percentiles are not judged here; those by order statistics are there beside the resampled ones.
        patch.setattr(acceptance_table, "RESAMPLES", 50)
        yield folder, data, measure_flight_tier(options(), [data], folder / "out", PlainProgress(io.StringIO()))


@pytest.mark.slow
def test_flights_are_rendered_navigated_and_judged(measured: tuple[Path, FlightData, list[AcceptanceRow]]) -> None:
    folder, _, rows = measured
    made = folder / "out" / "analytic" / "small-flights"
    # More sequences than the recipe has, each of the others in a scene of its own.
    frames = Dataset(made / "dataset")
    assert len(frames.frame_indices) == 40 and {frames.record(k).scene_id for k in (0, 20)} == {0, 1}
    assert json.loads((made / "benchmark.json").read_text())["sequences"]["count"] == 2
    names = {estimate.method for estimate in read_estimates(made / "estimates.jsonl")}
    assert names == {BEST, FILTERED, "paper", "paper+filter"}
    untracked = {estimate.method for estimate in read_estimates(made / "all-methods.jsonl")}
    assert untracked == set(method_names())
    numbers = [row.bar for row in rows]
    assert {"17", "18", "19", "20", "21", "24", "25", "27", "beside", "goal"} <= set(numbers)
    assert all(row.quantity.startswith("analytic, small-flights") for row in rows)
    by_title = {row.quantity: row for row in rows}
    unseen = by_title[f"analytic, small-flights, {BEST}: poses while hidden"]
    # 0.16 s at 25 a second in each of two flights, and the ends of both turns.
    assert unseen.n >= 8 and unseen.measured == 0
    beside = by_title["analytic, small-flights, detector at every pair, mean-plane: mean position error [mm]"]
    assert beside.bar == "beside" and beside.measured is not None


def test_scores_are_those_of_the_records(tmp_path: Path) -> None:
    dataset, file = rendered(RECIPE, tmp_path / "dataset"), tmp_path / "estimates.jsonl"
    estimates = {estimate.frame_index: estimate for estimate in navigate(BlindDataset(dataset), [BEST])}
    write_estimates(file, estimates.values())
    frames, scores = Dataset(dataset), score_pairs(dataset, file)
    assert len(scores[BEST]) == 20
    for scored in scores[BEST]:
        record, estimate = frames.record(scored.pair.frame_index), estimates[scored.pair.frame_index]
        features = [(*view.markers, view.hub) for view in (record.views.left, record.views.right)]
        whole = [
            sum(f is not None and f.visible_fraction >= 0.9 and f.in_image for f in view[:-1]) for view in features
        ]
        hubs = [view[-1] is not None and view[-1].visible_fraction >= 0.9 for view in features]
        assert scored.pair.in_view == (min(whole) >= 4 and all(hubs))
        assert scored.pair.sequence_id == scored.pair.frame_index // 20
        if scored.error is None:
            assert estimate.status == "no_fix" and scored.reason == estimate.reason
            continue
        assert estimate.status == "fix" and record.left_from_drogue is not None
        offset_m = estimate.left_from_drogue.translation_m - record.left_from_drogue.translation_m
        np.testing.assert_array_equal(scored.error[:3], offset_m)


@pytest.mark.slow
def test_what_is_there_is_kept(
    measured: tuple[Path, FlightData, list[AcceptanceRow]],
) -> None:
    folder, data, rows = measured
    told = io.StringIO()
    again = measure_flight_tier(options(), [data], folder / "out", PlainProgress(told))
    assert again == rows
    assert told.getvalue().count("jsonl exists already") == 3 and "40 of 40 pairs exist already" in told.getvalue()


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"recipes": ("demo",)}, r"--recipe: docking has none named 'demo'; there are docking-10m, "),
        ({"recipes": ("docking-10m",), "sequences": 0}, r"--sequences: must be at least 1, got 0"),
        ({"recipes": ("docking-10m",), "rigs": ("stereo",)}, r"--rig stereo: .*no rig named 'stereo'"),
        ({"recipes": ("docking-10m",), "engines": ("povray",)}, r"no engine named 'povray'"),
        # What is wrong may come late among the options.
        ({"recipes": ("docking-10m",), "engines": ("analytic", "povray")}, r"no engine named 'povray'"),
        ({"recipes": ("docking-10m",), "rigs": ("rgb-ideal", "stereo")}, r"no rig named 'stereo'"),
        ({"recipes": ("docking-10m", "drogue-lost"), "engines": ("analytic",)}, r"draws no obstacles"),
        ({"recipes": ("docking-10m",), "tracker": "hound"}, r"--tracker: must be one of .*, got 'hound'"),
        ({"recipes": ("drogue-lost",), "engines": ("analytic",)}, r"--engine analytic: .*draws no obstacles"),
    ],
)
def test_wrong_options_are_named(tmp_path: Path, changes: dict[str, object], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        measure_tier(options(**changes), tmp_path / "out", PlainProgress(io.StringIO()))
    assert not (tmp_path / "out").exists()


def test_pairs_that_cannot_be_made_are_a_fault(tmp_path: Path) -> None:
    (tmp_path / "turned.toml").write_text(TURNED)
    data, turned = (
        FlightData(str(tmp_path / "turned.toml"), 2, approach_rows),
        AcceptanceOptions("docking", 10, workers=0),
    )
    with pytest.raises(
        ValueError, match=r"2 pairs could not be made, pair 2 the first: .*; the criteria count every pair"
    ):
        measure_flight_tier(turned, [data], tmp_path / "out", PlainProgress(io.StringIO()))
    assert not list((tmp_path / "out").rglob("bars.json")) and not list((tmp_path / "out").rglob("estimates.jsonl"))


def test_the_first_sequences_are_those_of_the_full_measurement() -> None:
    for tier in FLIGHT_TIERS.values():
        for (data, few), (_, full) in zip(
            plan_flights(options(sequences=1), tier), plan_flights(options(), tier), strict=True
        ):
            assert (
                few.source.recipe.model_dump_json() == full.source.recipe.model_dump_json() and few.names == full.names
            )
            assert (few.count, full.count) == (
                part_length(few.source.recipe),
                data.parts * part_length(few.source.recipe),
            )


def test_tier_b_has_a_dataset_for_each_engine_that_is_named() -> None:
    tier_b = AcceptanceOptions("b", 3, pairs_per_station=2, engines=("mitsuba", "blender"))
    plans = [plan for _, plan in plan_images(tier_b)]
    assert [plan.names for plan in plans] == [(e, light) for e in tier_b.engines for light in ("day", "dusk")]
    assert [plan.source.recipe.render.engine for plan in plans] == ["mitsuba", "mitsuba", "blender", "blender"]
    assert [plan.names for _, plan in plan_images(AcceptanceOptions("b", 3))] == [("day",), ("dusk",)]


def test_one_light_alone_has_the_dataset_that_it_has_beside_the_other() -> None:
    (_, (_, beside)), ((light, alone),) = (
        plan_images(AcceptanceOptions("a", 3)),
        plan_images(AcceptanceOptions("a", 3, lights=("dusk",))),
    )
    assert light == "dusk" and (alone.names, alone.count) == (beside.names, beside.count)
    assert alone.source.recipe.model_dump_json() == beside.source.recipe.model_dump_json()


@pytest.mark.slow
def test_rows_of_tier_b_name_the_engine_that_was_asked_for(tmp_path: Path) -> None:
    tier_b = AcceptanceOptions("b", 3, pairs_per_station=1, engines=("analytic",), workers=0)
    table = measure_tier(tier_b, tmp_path, PlainProgress(io.StringIO()))
    assert table.rows and all(row.quantity.startswith("analytic, ") for row in table.rows)
    assert (tmp_path / "analytic" / "day" / "benchmark.json").exists()


@pytest.mark.slow
def test_centroids_are_timed_on_pairs_that_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("studies.acceptance.__main__._TIMED_PAIRS", 1)
    told = io.StringIO()
    tables = [
        measure_tier(AcceptanceOptions("speed", 3, draws=2, workers=0), tmp_path, PlainProgress(told)) for _ in range(2)
    ]
    assert "9 of 9 pairs exist already" in told.getvalue()
    for table in tables:
        measured = {row.quantity: row.measured for row in table.rows}
        near, far = (measured[f"centroids of both eyes, {z_m} m, median [ms]"] for z_m in (2, 10))
        assert near is not None and far is not None and min(near, far) > 0


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["a", "--engine", "blender"], "--engine: is for tiers b, e and docking"),
        (["c", "--light", "day"], "--light: is for tiers a and b"),
        (["b", "--tracker", "flow"], "--recipe, --sequences, --rig, --tracker: are for tiers e and docking"),
    ],
)
def test_options_of_other_tiers_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], fault: str
) -> None:
    assert run_command([*arguments, "--out", str(tmp_path / "out")]) == WRONG_INPUT
    assert fault in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
