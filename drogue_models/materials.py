"""What each part's surface reflects."""

from __future__ import annotations

from drogue_models.parameters import DrogueParameters, ReflectanceRgb, SatinPaint
from drogue_models.parts import FIRST_MARKER_ID, Part

# Light grey of military transports, close to FS 36375 (our choice).
TANKER_GREY: ReflectanceRgb = (0.36, 0.37, 0.38)


def part_satin(drogue: DrogueParameters, part_id: int) -> SatinPaint | None:
    """The sheen of a part (see `drogue_models.parts`), None where it is matt."""
    satin = drogue.satin
    return satin if satin is not None and part_id in {Part[name.upper()] for name in satin.parts} else None


def part_reflectance_rgb(drogue: DrogueParameters, part_id: int) -> tuple[float, float, float]:
    """Diffuse reflectance of a part in linear Rec. 709.

    Args:
        drogue: whose surfaces.
        part_id: see `drogue_models.parts`.

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
    if drogue.hub is not None:
        reflectances[Part.HUB] = drogue.hub.reflectance_rgb
    if part_id not in reflectances:
        raise ValueError(f"part_id: drogue {drogue.name} has no surface with this id, got {part_id}")
    return reflectances[Part(part_id)]
