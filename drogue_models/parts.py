"""The part ids that renderers write and labels read, and what each part reflects."""

from __future__ import annotations

from enum import IntEnum

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.parameters import DrogueParameters, SatinPaint

FIRST_MARKER_ID = 32
MAX_MARKERS = 32
# Parts of the k-th drogue beside the sought one have ids higher by k times this.
INSTANCE_STEP = 64
MAX_NEIGHBOURS = 2


class Part(IntEnum):
    """Id of the part that a pixel centre sees; marker i is `FIRST_MARKER_ID + i`."""

    SKY = 0
    FACE = 1
    RIM = 2
    CANOPY = 3
    RIBS = 4
    COUPLING = 5
    HUB = 6
    LAMPS = 7
    HOSE = 16
    TANKER = 17
    PROBE = 18
    OBSTACLE = 19
    DISTRACTOR = 20
    BOARD = 21


# Parts around the drogue, outside its box.
SURROUNDING_PARTS = (Part.HOSE, Part.TANKER, Part.PROBE, Part.OBSTACLE, Part.DISTRACTOR, Part.BOARD)
# Parts of the receiver, which fly with its cameras.
RECEIVER_PARTS = (Part.PROBE, Part.OBSTACLE)
# Parts that the drogue's box covers, besides the markers.
DROGUE_PARTS = (Part.FACE, Part.RIM, Part.CANOPY, Part.RIBS, Part.COUPLING, Part.HUB, Part.LAMPS)


def marker_id(index: int) -> int:
    """Part id of marker `index`.

    Raises:
        ValueError: more markers than ids.
    """
    if not 0 <= index < MAX_MARKERS:
        raise ValueError(f"marker index: must be in [0, {MAX_MARKERS}), got {index}")
    return FIRST_MARKER_ID + index


def drogue_part_ids(marker_count: int, instance: int = 0) -> list[int]:
    """Ids of all parts that a drogue's box covers; instance 0 is the drogue that is sought, 1 the first beside it."""
    own = [int(part) for part in DROGUE_PARTS] + [marker_id(index) for index in range(marker_count)]
    return [INSTANCE_STEP * instance + part for part in own]


def part_name(part_id: int) -> str:
    """Name of a part in messages and files, such as `face`, `marker_3` or `neighbour_1_face`.

    Raises:
        ValueError: no part has this id.
    """
    instance, own = divmod(part_id, INSTANCE_STEP)
    if 0 < instance <= MAX_NEIGHBOURS:
        return f"neighbour_{instance}_{part_name(own)}"
    if FIRST_MARKER_ID <= part_id < FIRST_MARKER_ID + MAX_MARKERS:
        return f"marker_{part_id - FIRST_MARKER_ID}"
    return Part(part_id).name.lower()


# Light grey of military transports, close to FS 36375 (our choice).
TANKER_GREY: ReflectanceRgb = (0.36, 0.37, 0.38)


def part_satin(drogue: DrogueParameters, part_id: int) -> SatinPaint | None:
    """The satin paint of a part, or None where it is matt."""
    satin = drogue.satin
    return satin if satin is not None and part_id in {Part[name.upper()] for name in satin.parts} else None


def part_reflectance_rgb(drogue: DrogueParameters, part_id: int) -> tuple[float, float, float]:
    """Diffuse reflectance of a part in linear Rec. 709.

    Args:
        drogue: with its surfaces.
        part_id: as in `Part`.

    Raises:
        ValueError: no surface has this id.
    """
    if FIRST_MARKER_ID <= part_id < FIRST_MARKER_ID + drogue.marker_count:
        return drogue.marker_reflectance_rgb
    reflectances = {
        Part.FACE: drogue.face_reflectance_rgb,
        Part.RIM: drogue.face_reflectance_rgb,
        Part.CANOPY: drogue.canopy_reflectance_rgb,
        Part.RIBS: drogue.structure_reflectance_rgb,
        Part.COUPLING: drogue.structure_reflectance_rgb,
        Part.HOSE: drogue.structure_reflectance_rgb,
        Part.TANKER: TANKER_GREY,
    }
    if drogue.body is not None and drogue.body.lamps is not None:
        reflectances[Part.LAMPS] = drogue.body.lamps.reflectance_rgb
    if drogue.hub is not None:
        reflectances[Part.HUB] = drogue.hub.reflectance_rgb
    if part_id not in reflectances:
        raise ValueError(f"part_id: drogue {drogue.name} has no surface with this id, got {part_id}")
    return reflectances[Part(part_id)]
