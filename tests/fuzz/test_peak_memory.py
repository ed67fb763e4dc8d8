"""Memory that every reader takes for the worst files of at most a megabyte."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from drogue_models.untrusted_files import MEMORY_BYTES_PER_BYTE, MOST_MEMORY_BYTES

MOST_FILE_BYTES = 10**6
# A reader holds the file itself, and what it has read of it, beside what the limit counts.
MOST_PEAK_BYTES = MOST_MEMORY_BYTES + MEMORY_BYTES_PER_BYTE * MOST_FILE_BYTES + 2**26


@pytest.mark.slow
def test_no_reader_takes_more_than_the_stated_memory_for_a_megabyte(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.support.peak_memory", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        found = [json.loads(line) for line in process.stdout]
    assert process.returncode == 0 and len(found) > 90
    for bomb in found:
        assert "fault" not in bomb, bomb
        assert bomb["most_bytes"] <= MOST_FILE_BYTES and bomb["lines"] == 1, bomb
        assert bomb["peak_bytes"] <= MOST_PEAK_BYTES, bomb
    peaks = {bomb["name"]: round(bomb["peak_bytes"] / 2**20) for bomb in found}
    print(f"most MiB: {sorted(peaks.items(), key=lambda item: -item[1])[:12]}")
