"""Errors and processing times of the estimates of a dataset's pairs."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from datasets_manifest.types.estimates import NoFix, write_estimates
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from droguekit.workflows.rendering import open_recipe
from studies.acceptance.rendered.sequence_pairs import score_pairs


def test_waiting_is_no_work(tmp_path: Path) -> None:
    source = open_recipe("smoke", None, "analytic")
    told = io.StringIO()
    summary = render_dataset(source, tmp_path / "dataset", range(1), 0, PlainProgress(told))
    assert summary.drops == (), told.getvalue()
    # Milliseconds that tell the stages apart in a sum.
    stages_ms = {
        "tracked": {"read": 512, "wait": 256, "track": 1, "handover": 128, "pose": 2, "filter": 4},
        "late": {"read": 512, "wait": 256},
        "silent": {},
    }
    answers = [
        NoFix(frame_index=0, method=name, reason="dark", stage_s={stage: 1e-3 * ms for stage, ms in spent.items()})
        for name, spent in stages_ms.items()
    ]
    write_estimates(tmp_path / "e.jsonl", answers)
    scores = score_pairs(tmp_path / "dataset", tmp_path / "e.jsonl")
    work_s = {name: scored.work_s for name, (scored,) in scores.items()}
    assert work_s == {"tracked": pytest.approx(0.007), "late": None, "silent": None}
