"""Paint of bodies: stripes, tape and lamps where the drogue has them, wear from its seed alone."""

from __future__ import annotations

import numpy as np
import pytest

from drogue_models.drogue_surfaces import drogue_surfaces
from drogue_models.painted_mesh import texels_at
from drogue_models.parts import FIRST_MARKER_ID, Part, part_reflectance_rgb
from drogue_models.presets import PRESETS, load_drogue, preset_names
from drogue_models.surface_looks import SurfaceWear

FAMILIES = [name for name in preset_names() if name not in PRESETS]
WEAR = SurfaceWear(seed=5)


@pytest.mark.parametrize("name", FAMILIES)
def test_surfaces_keep_the_shape_of_their_meshes(name: str) -> None:
    drogue = load_drogue(name)
    for wear in (None, WEAR):
        for part, surface in drogue_surfaces(drogue, wear).items():
            assert surface.has_map or np.array_equal(surface.reflectance, part_reflectance_rgb(drogue, part))
            if part >= FIRST_MARKER_ID:
                assert not surface.has_map
            if surface.has_map:
                height, width = surface.reflectance.shape[:2]
                assert height <= 256 and width <= 512
                assert surface.reflectance.min() >= 0.01 and surface.reflectance.max() <= 0.95


def test_stripes_alternate_with_the_canopy_around_the_axis() -> None:
    drogue = load_drogue("basket-orange-stripes")
    canopy = drogue_surfaces(drogue)[int(Part.CANOPY)]
    assert canopy.uv is not None and drogue.body is not None and drogue.body.stripes is not None
    points = np.asarray(canopy.mesh.vertices)
    # The first stripe lies around the +y axis, the next canopy paint half a period further.
    period = 2 * np.pi / drogue.body.stripes.count
    turn = (np.arctan2(points[:, 1], points[:, 0]) - np.pi / 2) % period / period
    paint = texels_at(canopy, canopy.uv)
    on_stripe = np.abs(paint - drogue.body.stripes.reflectance_rgb).max(axis=1) < 1e-3
    on_canopy = np.abs(paint - np.array(drogue.canopy_reflectance_rgb)).max(axis=1) < 1e-3
    # A texel is an eighth of a period.
    middle = np.minimum(turn, 1 - turn)
    assert on_stripe[middle < 0.15].all() and on_canopy[middle > 0.35].all()
    assert on_stripe.any() and on_canopy.any()


def test_tape_goes_around_the_small_canopy_and_its_coupling() -> None:
    drogue = load_drogue("basket-small-orange")
    surfaces = drogue_surfaces(drogue)
    for part, bands in ((Part.CANOPY, 1), (Part.COUPLING, 2)):
        column = surfaces[int(part)].reflectance[:, 0, 2]
        taped = column > 0.55
        assert np.count_nonzero(np.diff(np.concatenate([[False], taped, [False]]).astype(int)) == 1) == bands
        # The share of the length that the tape takes, to a row on either side of each band.
        assert drogue.body is not None and drogue.body.tape is not None
        assert abs(taped.mean() - drogue.body.tape.width_fraction) <= 2 * bands / len(column)


def test_lamps_shine_with_their_luminance_or_not_at_all() -> None:
    lit = drogue_surfaces(load_drogue("basket-black-lamps"))[int(Part.LAMPS)]
    # Luminance of linear Rec. 709.
    assert lit.emission_cd_m2 @ [0.2126, 0.7152, 0.0722] == pytest.approx(1500.0, rel=1e-12)
    off = drogue_surfaces(load_drogue("basket-tube"))[int(Part.LAMPS)]
    assert not off.emission_cd_m2.any()


def test_wear_comes_from_its_seed() -> None:
    drogue = load_drogue("petals-metal")
    first = drogue_surfaces(drogue, WEAR)[int(Part.CANOPY)].reflectance
    drogue_surfaces.cache_clear()
    again = drogue_surfaces(drogue, WEAR)[int(Part.CANOPY)].reflectance
    other = drogue_surfaces(drogue, WEAR.model_copy(update={"seed": 6}))[int(Part.CANOPY)].reflectance
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.02
    # Worn paint is uneven, but still the paint.
    mean = first.reshape(-1, 3).mean(axis=0)
    assert first.std() > 0.005
    assert 0.5 < float(mean[0]) / drogue.canopy_reflectance_rgb[0] < 1.2
