"""What was found, kept on disk by name, so that a run that was stopped goes on where it was."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import write_text_atomic

Found = dict[str, Any]


class Findings:
    """A folder of found things; each names what it was made from, and counts for nothing else."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str, made_from: Found) -> Found | None:
        """What was found under this name from the same things, None if nothing was."""
        try:
            kept = json.loads(self._file(name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        # As JSON has it: tuples are lists there.
        same = isinstance(kept, dict) and kept.get("made_from") == json.loads(json.dumps(made_from))
        return kept["found"] if same else None

    def keep(self, name: str, made_from: Found, found: Found) -> None:
        """Keep what was found; the file is there whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        write_text_atomic(self._file(name), json.dumps({"made_from": made_from, "found": found}, indent=1) + "\n")

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.json"
