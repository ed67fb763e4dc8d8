"""The scaling benchmark measures and stores its figures; the Job on the page about scaling works."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import studies.scaling.__main__ as scaling
from droguekit.batch.progress import PlainProgress
from droguekit.cli.main import DONE, run
from studies.scaling import large_dataset
from studies.scaling.__main__ import RESULTS_FILE, dask_cost, measure, table
from tests.support.batch_datasets import ANALYTIC_RECIPE, file_hashes

PAGE = Path(__file__).resolve().parents[3] / "docs/how-to/scale-out.md"


def test_empty_frames_are_measured_once(tmp_path: Path) -> None:
    told = PlainProgress(io.StringIO())
    first = measure(tmp_path, 2, 10, ("local",), told)
    ((name, cost),) = first.items()
    assert name == "10 empty frames, 2 workers here"
    assert set(cost["cpu_ms"]) == {"client", "workers"}
    # Two processes import what a frame needs, which takes far more than a hundredth of a second a frame of ten.
    assert cost["cpu_ms"]["workers"] > 10.0
    assert [int(count) for count in cost["client_mib"]] == [2, 4, 6, 8, 10]
    known = json.loads((tmp_path / RESULTS_FILE).read_text())
    known[name]["wall_ms"] = 12345.0
    (tmp_path / RESULTS_FILE).write_text(json.dumps(known))
    again = measure(tmp_path, 2, 10, ("local",), told)
    assert "wall 12345.00 ms" in table(again)[0]


def test_figures_of_other_code_of_the_study_are_not_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = PlainProgress(io.StringIO())
    folder = tmp_path / "dataset"
    for module, again in (
        (scaling, lambda: measure(tmp_path, 2, 10, (), told)),
        (large_dataset, lambda: large_dataset.measure(folder, 40, ["none"], told)),
    ):
        rooms: list[str] = []
        monkeypatch.setattr(module, "rendering_build", rooms.extend)
        assert not again()
        assert "studies.scaling" in rooms


@pytest.mark.slow  # starts a scheduler and a worker, which other tests do too
def test_dask_is_measured_process_by_process(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask is missing: pip install 'droguekit[cluster]'")
    cost = dask_cost(tmp_path / "empty", 10, 1, PlainProgress(io.StringIO()))
    assert set(cost["cpu_ms"]) == {"client", "scheduler", "workers"}
    assert all(spent > 0 for spent in cost["cpu_ms"].values())


def test_the_table_divides_clock_by_clock() -> None:
    one = {"workers": 1, "pairs": 200, "wall_s": 200.0, "cpu_s": 190.0, "frames_cpu_s": 180.0}
    two = {**one, "workers": 2, "wall_s": 104.0, "cpu_s": 200.0}
    head, first, second = table({"a": one, "b": two})
    assert head.split()[:6] == ["pairs", "workers", "wall", "s", "CPU", "s"]
    assert first.split() == ["200", "1", "200.0", "190.0", "0.90", "0.95", "1.00"]
    assert second.split() == ["200", "2", "104.0", "200.0", "0.90", "1.92", "1.92"]


@pytest.mark.slow
def test_the_kubernetes_job_makes_shards_that_merge(analytic_dataset: Path, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with Dask: pip install 'droguekit[cluster]'")
    (block,) = re.findall(r"^```yaml\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    job = yaml.safe_load(block)["spec"]
    assert (job["completionMode"], job["completions"]) == ("Indexed", job["parallelism"])
    *shell, text = job["template"]["spec"]["containers"][0]["command"]
    assert f"--shard $JOB_COMPLETION_INDEX/{job['completions']}" in text
    text = text.replace(f"/{job['completions']}", "/2 --workers 0").replace("/data", str(tmp_path))
    text = text.replace("exec droguekit", f"exec {sys.executable} -m droguekit.cli.main")
    (tmp_path / "recipe.toml").write_text(ANALYTIC_RECIPE)
    for index in ("0", "1"):
        subprocess.run([*shell, text], env={**os.environ, "JOB_COMPLETION_INDEX": index}, check=True)
    shards = [str(tmp_path / "shard-0"), str(tmp_path / "shard-1")]
    assert run(["merge", str(tmp_path / "whole"), *shards]) == DONE
    assert file_hashes(tmp_path / "whole") == file_hashes(analytic_dataset)
