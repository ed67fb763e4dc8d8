"""Coverage counted by cell, against counts made by hand from the records."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import NoFix, PoseEstimate, write_estimates
from droguekit.assurance.coverage import (
    Coverage,
    CrossingCoverage,
    DomainCell,
    Share,
    coverage_lines,
    measure_coverage,
    worst_cell,
)
from droguekit.assurance.design_domain import CLOSED_WORDS, SHIPPED, WORDS, DesignDomain, load_domain
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from droguekit.scoring.confidence_intervals import fraction_interval
from geometry.se3 import Array, RigidTransform
from tests.support.recipe_builder import RIG_160_PX, between, recipe_text
from tests.support.small_datasets import rendered

EDGES_M = (2.0, 4.0, 8.0, 10.0)
DOMAIN = """
name = "near"
[quantities.distance_m]
edges = [2.0, 4.0, 8.0, 10.0]
[quantities.sun_elevation_deg]
edges = [-90.0, 0.0, 90.0]
[[cells]]
of = ["distance_m", "sun_elevation_deg"]
fewest_pairs = 1
[[cells]]
of = ["distance_m"]
fewest_pairs = 0
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pairs by day alone from 2 to 12 m, of which some are empty."""
    recipe = recipe_text(
        name="covered",
        seed=4,
        rig=RIG_160_PX,
        frames={"count": 40, "scenes": 4, "empty_fraction": 0.2},
        distance=between(2.0, 12.0),
        environment={"sun_elevation_deg": [20, 60]},
        render={"engine": "analytic"},
    )
    return rendered(recipe, tmp_path_factory.mktemp("covered") / "dataset")


@pytest.fixture
def domain(tmp_path: Path) -> Path:
    path = tmp_path / "near.toml"
    path.write_text(DOMAIN)
    return path


def distances_m(dataset: Path) -> Array:
    source = Dataset(dataset)
    found = [source.record(index).conditions.distance_m for index in source.frame_indices]
    return np.array([np.nan if distance is None else distance for distance in found])


def of(coverage: Coverage, *names: str) -> CrossingCoverage:
    (found,) = (crossing for crossing in coverage.crossings if crossing.of == names)
    return found


def test_cells_hold_the_pairs_of_the_records(dataset: Path, domain: Path) -> None:
    found = measure_coverage(dataset, load_domain(str(domain)))
    seen_m = distances_m(dataset)
    expected = np.histogram(seen_m[np.isfinite(seen_m)], EDGES_M)[0]
    assert [cell.pairs for cell in of(found, "distance_m").cells] == expected.tolist()
    assert of(found, "distance_m").outside == found.outside["distance_m"] == (seen_m > EDGES_M[-1]).sum() > 0
    crossed = {cell.bins: cell.pairs for cell in of(found, "distance_m", "sun_elevation_deg").cells}
    assert [crossed[f"{low:g} to {high:g}", "0 to 90"] for low, high in pairwise(EDGES_M)] == (expected.tolist())
    night = of(found, "distance_m", "sun_elevation_deg").lacking
    assert {cell.bins[1] for cell in night} == {"-90 to 0"} and len(night) == 3
    assert not of(found, "distance_m").lacking


def test_bins_of_close_edges_stay_apart(dataset: Path) -> None:
    """Six digits name all of them alike; the pairs of the first bin lie in no other."""
    first_m, *_ = np.unique(distances_m(dataset))
    edges_m = (float(first_m), float(first_m) + 1e-7, float(first_m) + 2e-7)
    domain = DesignDomain.model_validate(
        {"name": "close", "quantities": {"distance_m": {"edges": edges_m}}, "cells": [{"of": ["distance_m"]}]}
    )
    cells = of(measure_coverage(dataset, domain), "distance_m").cells
    assert len({cell.bins for cell in cells}) == 2
    assert [cell.pairs for cell in cells] == [1, 0]


def test_words_of_pairs_are_among_those_that_a_domain_may_name(dataset: Path) -> None:
    for record in Dataset(dataset).records():
        for name, known in CLOSED_WORDS.items():
            word = WORDS[name](record)
            assert word is None or word in known


def test_an_empty_cell_ends_the_command_with_a_fault(
    dataset: Path, domain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers, page = tmp_path / "coverage.json", tmp_path / "new" / "coverage.html"
    command = ["coverage", str(dataset), "--odd", str(domain), "--json", str(numbers), "--html", str(page)]
    assert run(command) == FAULT
    told = capsys.readouterr().out
    assert "distance_m x sun_elevation_deg: 6 cells, each to have 1 pair: 3 lack pairs" in told
    assert "  distance_m 2 to 4, sun_elevation_deg -90 to 0: 0 pairs" in told
    assert Coverage.model_validate(json.loads(numbers.read_text())) == measure_coverage(
        dataset, load_domain(str(domain))
    )
    assert page.read_text().count('class="lacks"') == 3
    domain.write_text(DOMAIN.replace("fewest_pairs = 1", "fewest_pairs = 0"))
    assert run(["coverage", str(dataset), "--odd", str(domain)]) == DONE


def test_poses_are_scored_cell_by_cell(dataset: Path, domain: Path, tmp_path: Path) -> None:
    source, path = Dataset(dataset), tmp_path / "e.jsonl"
    estimates: list[PoseEstimate | NoFix] = []
    for index in source.frame_indices:
        pose = source.record(index).left_from_drogue
        if pose is None:
            estimates.append(NoFix(frame_index=index, method="far", reason="nothing there"))
            continue
        # Right up to 8 m and wrong by 2 % beyond; the domain allows 1 %.
        scale = 1.005 if pose.translation_m[2] < 8 else 1.02
        moved = RigidTransform(pose.rotation, pose.translation_m * scale)
        estimates.append(PoseEstimate(frame_index=index, method="far", left_from_drogue=moved))
    write_estimates(path, estimates)
    crossing = of(measure_coverage(dataset, load_domain(str(domain)), path), "distance_m")
    shares = [cell.scores["far"] for cell in crossing.cells]
    assert [share.hits for share in shares] == [crossing.cells[0].pairs, crossing.cells[1].pairs, 0]
    assert [share.count for share in shares] == [cell.pairs for cell in crossing.cells]
    worst = worst_cell(crossing, "far")
    assert worst is not None and worst.bins == ("8 to 10",)


def test_shares_are_never_rounded_to_all_or_none() -> None:
    def lines(*hits: int) -> list[str]:
        cells = tuple(
            DomainCell(
                bins=(str(place),),
                pairs=300,
                scores={"own": Share(hits=count, count=300, interval=fraction_interval(count, 300))},
            )
            for place, count in enumerate(hits)
        )
        crossing = CrossingCoverage(of=("x",), fewest_pairs=0, outside=0, cells=cells)
        coverage = Coverage(
            dataset="d", dataset_sha256="0", domain="o", pairs=600, outside={}, scored=("own",), crossings=(crossing,)
        )
        return list(coverage_lines(coverage))

    assert lines(300, 299)[-1] == "  own is worst at x 1: 299 of 300 solved, 98.1 to 99.9 %"
    assert lines(300, 300)[-1] == "  own solved every case"


def test_boxes_are_scored_cell_by_cell(dataset: Path, domain: Path, tmp_path: Path) -> None:
    boxes, coco = tmp_path / "boxes.json", json.loads((dataset / "annotations" / "all.json").read_text())
    source = Dataset(dataset)
    near = {index for index in source.frame_indices if (source.record(index).conditions.distance_m or 99) < 4}
    frame_of_image = {image["id"]: image["file_name"] for image in coco["images"]}
    found = [
        {"image_id": label["image_id"], "category_id": 1, "bbox": label["bbox"], "score": 0.9}
        for label in coco["annotations"]
        if label["category_id"] == 1 and int(Path(frame_of_image[label["image_id"]]).parent.name) in near
    ]
    boxes.write_text(json.dumps(found))
    crossing = of(measure_coverage(dataset, load_domain(str(domain)), None, [boxes]), "distance_m")
    shares = [cell.scores["boxes"] for cell in crossing.cells]
    assert shares[0].hits == shares[0].count > 0
    assert [share.hits for share in shares[1:]] == [0, 0]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("edges = [2.0, 4.0, 8.0, 10.0]", "edges = [2.0, 2.0]", r"quantities\.distance_m: edges: must be at least two"),
        (
            "quantities.distance_m",
            "quantities.distance",
            r"quantities\.distance: no such quantity; there are distance_m",
        ),
        ('of = ["distance_m"]', 'of = ["roll_deg"]', r"cells: 'roll_deg' is none of the quantities"),
        ("edges = [2.0, 4.0, 8.0, 10.0]", 'values = ["a"]', r"quantities\.distance_m: needs edges"),
        ("name =", "name", "near.toml: not valid TOML"),
        (
            "[[cells]]",
            '[quantities.tanker]\nvalues = ["wing", "zeppelin"]\n[[cells]]',
            r"quantities\.tanker: no such value: zeppelin; there are none, wing, four-jet",
        ),
    ],
)
def test_a_wrong_domain_is_one_clear_line(
    dataset: Path, domain: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, told: str
) -> None:
    domain.write_text(DOMAIN.replace(old, new, 1))
    with pytest.raises(ValueError, match=told):
        load_domain(str(domain))
    assert run(["coverage", str(dataset), "--odd", str(domain)]) == WRONG_INPUT
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_domains_say_where_their_numbers_come_from(name: str) -> None:
    domain = load_domain(name)
    assert domain.description
    assert all(quantity.source for quantity in domain.quantities.values() if quantity.edges is not None)


def test_two_detection_files_of_one_name_are_refused(
    dataset: Path, domain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["coverage", str(dataset), "--odd", str(domain)]
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "boxes.json").write_text("[]")
        command += ["--detections", str(tmp_path / folder / "boxes.json")]
    assert run(command) == WRONG_INPUT
    assert "--detections: two are named 'boxes'; rename a file" in capsys.readouterr().err
