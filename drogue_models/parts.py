"""The part ids that renderers write and labels read."""

from __future__ import annotations

from enum import IntEnum

FIRST_MARKER_ID = 32
MAX_MARKERS = 32


class Part(IntEnum):
    """What a pixel centre sees; marker i is `FIRST_MARKER_ID + i`."""

    SKY = 0
    FACE = 1
    RIM = 2
    CANOPY = 3
    RIBS = 4
    COUPLING = 5
    HUB = 6
    HOSE = 16
    TANKER = 17
    PROBE = 18
    OBSTACLE = 19
    DISTRACTOR = 20
    BOARD = 21


# What hangs on the drogue or stands around it; none of it belongs to the drogue's box.
SURROUNDING_PARTS = (Part.HOSE, Part.TANKER, Part.PROBE, Part.OBSTACLE, Part.DISTRACTOR, Part.BOARD)
# What the drogue's box covers besides the markers.
DROGUE_PARTS = (Part.FACE, Part.RIM, Part.CANOPY, Part.RIBS, Part.COUPLING, Part.HUB)


def marker_id(index: int) -> int:
    """Part id of marker `index`.

    Raises:
        ValueError: more markers than ids.
    """
    if not 0 <= index < MAX_MARKERS:
        raise ValueError(f"marker index: must be in [0, {MAX_MARKERS}), got {index}")
    return FIRST_MARKER_ID + index


def drogue_part_ids(marker_count: int) -> list[int]:
    """All ids that belong to the drogue's box."""
    return [int(part) for part in DROGUE_PARTS] + [marker_id(index) for index in range(marker_count)]


def part_name(part_id: int) -> str:
    """Name of a part for people and files: `face`, `marker_3`.

    Raises:
        ValueError: no part has this id.
    """
    if FIRST_MARKER_ID <= part_id < FIRST_MARKER_ID + MAX_MARKERS:
        return f"marker_{part_id - FIRST_MARKER_ID}"
    return Part(part_id).name.lower()
