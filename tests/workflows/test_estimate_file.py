"""Two runs that write estimates into one file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from datasets_manifest.types.estimates import NoFix
from droguekit.workflows.estimate_file import EstimateFile


def answer(frame_index: int) -> NoFix:
    return NoFix(frame_index=frame_index, method="none", reason="no method")


@pytest.mark.parametrize("is_there", [False, True])
def test_a_second_run_cannot_take_the_file_of_a_running_one(is_there: bool, tmp_path: Path) -> None:
    path = tmp_path / "estimates.jsonl"
    if is_there:
        path.write_text("older\n")
    with EstimateFile(path) as first:
        first.write(answer(0))
        with pytest.raises(ValueError, match="another run is writing it"), EstimateFile(path):
            pass
        first.write(answer(1))
    assert [NoFix.model_validate_json(line) for line in path.read_text().splitlines()] == [answer(0), answer(1)]
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_dead_run_left_is_replaced(tmp_path: Path) -> None:
    path, left = tmp_path / "estimates.jsonl", tmp_path / "estimates.jsonl.part"
    path.write_text("older\n")
    left.write_text("half a line" * 100)
    with EstimateFile(path) as file:
        file.write(answer(3))
    assert NoFix.model_validate_json(path.read_text()) == answer(3)
    assert list(tmp_path.iterdir()) == [path]


def test_standard_output_in_a_file_is_written_to(tmp_path: Path) -> None:
    script = (
        "from pathlib import Path\n"
        "from tests.workflows.test_estimate_file import answer\n"
        "from droguekit.workflows.estimate_file import EstimateFile\n"
        "with EstimateFile(Path('/dev/stdout')) as file:\n"
        "    file.write(answer(5))\n"
    )
    out = tmp_path / "out.jsonl"
    with out.open("w") as stream:
        subprocess.run([sys.executable, "-c", script], stdout=stream, check=True)
    assert NoFix.model_validate_json(out.read_text()) == answer(5)
