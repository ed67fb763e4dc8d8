"""The drogues that ship, and reading a user's own from TOML."""

from __future__ import annotations

import tomllib
from pathlib import Path

from pydantic import ValidationError

from drogue_models.parameters import WHITE_PAINT, DrogueParameters, HubParameters, even_ring

# The largest even ring that leaves 10 mm of dark face around markers of 0.10 m inside a rim of 0.33 m.
RING_RADIUS_M = 0.27


def _red(count: int) -> DrogueParameters:
    return DrogueParameters(name=f"red-{count}", marker_positions_m=even_ring(count, RING_RADIUS_M))


def _white(count: int) -> DrogueParameters:
    return DrogueParameters(
        name=f"white-{count}",
        marker_positions_m=even_ring(count, RING_RADIUS_M),
        marker_reflectance_rgb=WHITE_PAINT,
        hub=HubParameters(reflectance_rgb=WHITE_PAINT),
    )


PRESETS: dict[str, DrogueParameters] = {
    drogue.name: drogue for drogue in (_red(8), _red(7), _red(5), _white(8), _white(7), _white(5))
}


def load_drogue(name_or_path: str, base: Path | None = None) -> DrogueParameters:
    """A shipped preset by name, or a drogue from a TOML file.

    Args:
        name_or_path: name of a preset, or path of a `.toml` file.
        base: folder against which a relative path is read; the working directory by default.

    Raises:
        ValueError: neither a preset nor a readable file, or a file whose keys are wrong; names the key.
    """
    if name_or_path in PRESETS:
        return PRESETS[name_or_path]
    if not name_or_path.endswith(".toml"):
        raise ValueError(
            f"drogue: no preset named {name_or_path!r}; there are {', '.join(PRESETS)}, or give a .toml file"
        )
    path = (base or Path()) / name_or_path
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid TOML: {error}") from error
    try:
        return DrogueParameters.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error


def explain(error: ValidationError) -> str:
    """All faults of a failed validation on one line, each with its key."""
    faults = []
    for fault in error.errors(include_url=False):
        where = ".".join(str(part) for part in fault["loc"])
        message = fault["msg"].removeprefix("Value error, ")
        value = fault["input"]
        got = f", got {value!r}" if isinstance(value, str | int | float | bool) else ""
        faults.append(f"{where}: {message}{got}" if where else f"{message}")
    return "; ".join(faults)
