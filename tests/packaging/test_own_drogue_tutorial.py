"""The tutorial of the user's own drogue, command by command as it stands in the page."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from droguekit.cli.main import DONE, run

PAGE = Path(__file__).parents[2] / "docs/tutorial/your-own-drogue.md"


# Ten commands on eight pairs of 960 x 600.
@pytest.mark.slow
def test_every_command_of_the_page_runs_and_ends_in_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    commands = [line for block in blocks for line in block.splitlines()]
    assert len(commands) == 10
    for command in commands:
        name, *arguments = shlex.split(command)
        assert name == "droguekit"
        if arguments[0] == "render":
            arguments += ["--workers", "0"]
        assert run(arguments) == DONE, command
    estimates = list(read_estimates(Path("estimates.jsonl")))
    assert len(estimates) == 8
    assert all(isinstance(estimate, PoseEstimate) for estimate in estimates)
    (method,) = json.loads(Path("benchmark.json").read_text())["methods"].values()
    # Centimetres at 15 m would be a wrong match; the bound is below a millimetre.
    assert method["overall"]["position_p95_m"] < 0.01
    assert "acme" in Path("report.html").read_text()
