"""One frame of every kind of body by both path tracers."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from datasets_manifest.recipe.recipe import RenderSettings
from drogue_models.parts import Part, drogue_part_ids
from geometry.stereo import EYES
from labelgen.frame_labels import label_frame
from labelgen.validation.label_checks import box_faults, check_against_passes, projection_faults
from render.camera.sensor import expose
from render.engine import RenderEngine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import RIG_320_PX, build_recipe, stations

KINDS = (
    "basket-black-lamps", "basket-strut-markers", "basket-tube", "petals-metal", "ribbons-grey", "cone-white",
    "cone-markers",
)  # fmt: skip

pytestmark = [
    pytest.mark.blender,
    pytest.mark.mitsuba,
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("bpy") is None, reason="bpy is missing: pip install 'droguekit[blender]'"
    ),
]


def test_engines_agree_on_the_parts_and_the_light_of_every_body(engine: RenderEngine) -> None:
    from render.blender_engine.blender_engine import BlenderEngine

    settings = RenderSettings(samples_per_px=16, surround_samples_per_px=4, edge_samples_per_px=64)
    blender = BlenderEngine()
    try:
        for name in KINDS:
            recipe = build_recipe(
                name="both", drogue=name, rig=RIG_320_PX, frames={"count": 1}, distance=stations(2.2),
                target={"wear": {}}, environment={"clouds": {"scene_fraction": 0.0}},
            )  # fmt: skip
            frame = sample_frame(recipe, 0)
            assert frame.drogue is not None
            ours, theirs = engine.render(frame, settings), blender.render(frame, settings)
            for radiance in (ours, theirs):
                record = label_frame(frame, radiance, expose(frame, radiance))
                faults = check_against_passes(record, radiance) + projection_faults(record) + box_faults(record)
                assert faults == [], name
                for view in (record.views.left, record.views.right):
                    full, seen = np.array(view.box_full_xywh_px), np.array(view.box_visible_xywh_px)
                    ends = np.append(full[:2] - seen[:2], full[:2] + full[2:] - seen[:2] - seen[2:])
                    # The outermost pixel centre lies within a pixel of the outline; the probe hides nothing here.
                    assert np.abs(ends).max() <= 1.0, name
            for eye in EYES:
                a, b = getattr(ours, eye), getattr(theirs, eye)
                drogue = np.isin(a.part_id, drogue_part_ids(frame.drogue.marker_count))
                border = binary_dilation(a.part_id != b.part_id)
                # Rays through pixel centres differ by float32 rounding, which matters only on outlines.
                assert np.count_nonzero(a.part_id != b.part_id) < 0.01 * np.count_nonzero(drogue), name
                inside = drogue & (b.part_id == a.part_id) & ~border & (a.coverage > 0.999) & (b.coverage > 0.999)
                light = [float((each.radiance_cd_m2[inside] @ REC709_LUMINANCE).mean()) for each in (a, b)]
                # Blender takes as many bounces as our tracer; basket and cone reflect much light onto themselves.
                assert light[0] == pytest.approx(light[1], rel=0.04), name
            lamps = ours.left.part_id == Part.LAMPS
            if frame.drogue.body is not None and frame.drogue.body.lamps is not None and lamps.any():
                lit = frame.drogue.body.lamps.luminance_cd_m2
                brightest = float((ours.left.radiance_cd_m2[lamps] @ REC709_LUMINANCE).max())
                assert brightest > 0.5 * lit
    finally:
        blender.close()
