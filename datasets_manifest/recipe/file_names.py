"""Names of files in the table of a recipe's TOML file."""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any


def move_file_names(table: MutableMapping[str, Any], before: Path, after: Path) -> None:
    """Name the files of a recipe as seen from another folder, in place; absolute names stay.

    Args:
        table: of a valid recipe, as its TOML file has it.
        before: folder that its relative names start from.
        after: folder that they are to start from.
    """

    def move(names: MutableMapping[str, Any], key: str) -> None:
        name = names.get(key)
        if isinstance(name, str) and not Path(name).is_absolute():
            names[key] = Path(os.path.relpath(before.resolve() / name, after.resolve())).as_posix()

    def move_drogue_or_rig(names: MutableMapping[str, Any], key: str) -> None:
        if str(names.get(key, "")).endswith(".toml"):  # else a preset's name or a table
            move(names, key)

    move_drogue_or_rig(table, "drogue")
    move_drogue_or_rig(table, "rig")
    for part in (table, *table.get("families", ())):
        for variant in part.get("target", {}).get("variants", ()):
            move_drogue_or_rig(variant, "drogue")
        environment = part.get("environment", {})
        if isinstance(environment.get("map"), str):
            move(environment, "map")
        elif "map" in environment:
            move(environment["map"], "file")
