"""The shipped drogues, and the reader of a user's drogue from TOML.

Rings like the seed paper's are made here; baskets, leaves, ribbons and cones are files in `drogue_families/presets`.
"""

from __future__ import annotations

import hashlib
import math
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from drogue_models.frozen_model import FrozenModel, Metres
from drogue_models.parameters import WHITE_PAINT, DrogueParameters, HubParameters, PlanePoint, even_ring
from drogue_models.parts import MAX_MARKERS
from drogue_models.untrusted_files import parse_toml, read_regular, read_text

MOST_FAULTS = 20
"""Most faults of a failed validation that a message names."""
_MOST_CHARACTERS = 200
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


@cache
def preset_names() -> tuple[str, ...]:
    """Names of all shipped drogues: rings first, then the others by name."""
    folder = files("drogue_models.drogue_families") / "presets"
    return (*PRESETS, *sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir()))


@cache
def _shipped(name: str) -> DrogueParameters:
    file = files("drogue_models.drogue_families") / "presets" / f"{name}.toml"
    return parse_drogue(file.read_text(encoding="utf-8"), Path())


def load_drogue(name_or_path: str, base: Path | None = None) -> DrogueParameters:
    """A shipped preset by name, or a drogue from a TOML file.

    The file holds the keys of `DrogueParameters`. Even rings may be given as `marker_count` and `marker_ring_radius_m`,
    or as a list `marker_rings`, instead of `marker_positions_m`. `hub = false` stands for no hub, and `body_mesh` is
    the path of a mesh, relative to the file.

    Args:
        name_or_path: name of a preset, or path of a `.toml` file.
        base: folder against which a relative path is read; the working directory by default.

    Raises:
        ValueError: neither a preset nor a readable file, or a file whose keys are wrong; names the key.
    """
    if name_or_path in PRESETS:
        return PRESETS[name_or_path]
    if name_or_path in preset_names():
        return _shipped(name_or_path)
    if not name_or_path.endswith(".toml"):
        raise ValueError(
            f"drogue: no preset named {name_or_path!r}; there are {', '.join(preset_names())}, or give a .toml file"
        )
    path = (base or Path()) / name_or_path
    try:
        return parse_drogue(read_text(path), path.parent)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not valid TOML: {error}") from error
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def parse_drogue(text: str, folder: Path) -> DrogueParameters:
    """A drogue from TOML text, see `load_drogue`.

    Args:
        text: TOML.
        folder: that a path of a mesh is relative to.

    Raises:
        ValueError: not TOML, or keys are wrong.
    """
    table = parse_toml(text)
    _expand_ring(table)
    _expand_rings(table)
    _pin_body_mesh(table, folder)
    if table.get("hub") is False:
        table["hub"] = None
    return DrogueParameters.model_validate(table)


def drogue_text(drogue: DrogueParameters) -> str:
    """TOML text that `parse_drogue` reads back as the same drogue; a body's mesh must lie in the file's folder."""
    import tomlkit

    table = drogue.model_dump(mode="json", exclude_none=True)
    if drogue.hub is None:
        table["hub"] = False
    if drogue.body_mesh is not None:
        table["body_mesh"] = drogue.body_mesh.path
    return tomlkit.dumps(table)


class MarkerRing(FrozenModel):
    """An even ring of markers in the short form of a TOML file.

    Attributes:
        count: of markers.
        radius_m: of the circle through their centres. [m]
        depth_m: behind the rim plane. [m]
        turn_deg: of the first marker from the +y axis towards -x.
    """

    count: int = Field(ge=1, le=MAX_MARKERS)
    radius_m: Metres
    depth_m: float = Field(default=0.0, ge=0, le=10)
    turn_deg: float = 0.0


# A ring has at least one marker.
_RINGS = TypeAdapter(Annotated[tuple[MarkerRing, ...], Field(max_length=MAX_MARKERS)])


def _expand_rings(table: dict[str, Any]) -> None:
    """Replace a list of rings by positions and depths, in place."""
    if "marker_rings" not in table:
        return
    for key in ("marker_positions_m", "marker_depths_m"):
        if key in table:
            raise ValueError(f"{key}: leave it out, or leave out marker_rings or marker_count")
    try:
        rings = _RINGS.validate_python(table.pop("marker_rings"))
    except ValidationError as error:
        raise ValueError(f"marker_rings: {explain(error)}") from error
    positions: list[PlanePoint] = []
    for ring in rings:
        turn = complex(math.cos(math.radians(ring.turn_deg)), math.sin(math.radians(ring.turn_deg)))
        turned = [complex(x, y) * turn for x, y in even_ring(ring.count, ring.radius_m)]
        positions += [(place.real, place.imag) for place in turned]
    table["marker_positions_m"] = positions
    depths = [ring.depth_m for ring in rings for _ in range(ring.count)]
    if any(depths):
        table["marker_depths_m"] = depths


def _expand_ring(table: dict[str, Any]) -> None:
    """Replace the short form of an even ring by its positions."""
    if "marker_count" not in table and "marker_ring_radius_m" not in table:
        return
    if "marker_positions_m" in table:
        raise ValueError("marker_positions_m: leave it out, or leave out marker_count and marker_ring_radius_m")
    count, radius_m = table.pop("marker_count", None), table.pop("marker_ring_radius_m", None)
    if not isinstance(count, int) or isinstance(count, bool) or not 3 <= count <= MAX_MARKERS:
        raise ValueError(f"marker_count: must be a whole number from 3 to {MAX_MARKERS}, got {count!r}")
    if not isinstance(radius_m, int | float) or isinstance(radius_m, bool) or not 0 < radius_m <= 10:
        raise ValueError(f"marker_ring_radius_m: must be a number above 0 and up to 10, got {radius_m!r}")
    table["marker_positions_m"] = even_ring(count, radius_m)


def _pin_body_mesh(table: dict[str, Any], folder: Path) -> None:
    """Replace the path of the body's mesh by path, hash and folder, in place."""
    if "body_mesh" not in table:
        return
    given = table["body_mesh"]
    if not isinstance(given, str) or not given:
        raise ValueError(f"body_mesh: must be the path of a mesh file, got {given!r}")
    try:
        data = read_regular(folder / given)
    except OSError as error:
        raise ValueError(f"body_mesh: {folder / given} cannot be read: {error.strerror}; correct the path") from error
    table["body_mesh"] = {"path": given, "sha256": hashlib.sha256(data).hexdigest(), "folder": folder}


def explain(error: ValidationError) -> str:
    """The faults of a failed validation on one line, each with its key; of very many the first ones."""
    faults = []
    for fault in error.errors(include_url=False)[:MOST_FAULTS]:
        where = ".".join(_shortened(str(part)) for part in fault["loc"])
        message = fault["msg"].removeprefix("Value error, ")
        value = fault["input"]
        got = f", got {_shortened(repr(value))}" if isinstance(value, str | int | float | bool) else ""
        faults.append(f"{where}: {message}{got}" if where else f"{message}")
    more = error.error_count() - MOST_FAULTS
    return "; ".join(faults) + (f"; and {more} more faults" if more > 0 else "")


def _shortened(text: str) -> str:
    return text if len(text) <= _MOST_CHARACTERS else f"{text[:_MOST_CHARACTERS]}..."
