"""The study of large datasets repeats few pairs into a dataset that commands accept, and measures each once."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import read_manifest
from droguekit.batch.progress import PlainProgress
from labelgen.validation.dataset_checks import validate_dataset
from studies.scaling.large_dataset import RESULTS_FILE, build_dataset, measure, table

RECORDS, PAIRS = 40, 3


def test_few_pairs_become_a_dataset_that_is_measured_once(tmp_path: Path) -> None:
    told = PlainProgress(io.StringIO())
    dataset = build_dataset(tmp_path, RECORDS, PAIRS, told)
    first, again = (frame_folder(dataset, index) for index in (1, 1 + PAIRS))
    assert (first / "left.png").samefile(again / "left.png")
    shutil.rmtree(first)
    assert build_dataset(tmp_path, RECORDS, PAIRS, told) == dataset
    costs = measure(dataset, RECORDS, ["render"], told)
    (cost,) = costs
    assert (cost.command, cost.records) == ("render", RECORDS)
    assert 0 < cost.cpu_s < 2.5 * cost.wall_s
    # An interpreter takes some 10 MB by itself.
    assert 10 < cost.peak_mb < 500
    assert validate_dataset(dataset).passed
    assert read_manifest(dataset).counts.pairs == RECORDS
    known = (tmp_path / RESULTS_FILE).read_bytes()
    assert measure(dataset, RECORDS, ["render"], told) == costs
    assert (tmp_path / RESULTS_FILE).read_bytes() == known
    assert table(costs)[2].startswith(f"| {RECORDS} | `render` | {cost.cpu_s:.1f} s |")
