"""One frame of every type of tanker by both path tracers."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from datasets_manifest.recipe.recipe import RenderSettings
from drogue_models.parts import Part
from drogue_models.tankers.tanker import PROPELLERS, STATIONS
from geometry.stereo import EYES
from labelgen.frame_labels import label_frame
from labelgen.validation.label_checks import check_against_passes
from render.camera.sensor import expose
from render.engine import RenderEngine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import RIG_320_PX, build_recipe, stations

pytestmark = [
    pytest.mark.blender,
    pytest.mark.mitsuba,
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("bpy") is None, reason="bpy is missing: pip install 'droguekit[blender]'"
    ),
]


def test_engines_agree_on_the_parts_and_the_light_of_every_tanker(engine: RenderEngine) -> None:
    from render.blender_engine.blender_engine import BlenderEngine

    blender = BlenderEngine()
    try:
        for name in STATIONS:
            # A multirotor has two hundred pixels, whose mean is noisier.
            settings = RenderSettings(samples_per_px=4, surround_samples_per_px=64 if name == "multirotor" else 4)
            recipe = build_recipe(
                name="both",
                rig=RIG_320_PX,
                frames={"count": 1},
                distance=stations(8.0),
                tanker={"variants": [{"type": name}], "line_m": 1, "line_drop_deg": 30},
            )
            frame = sample_frame(recipe, 0)
            ours, theirs = engine.render(frame, settings), blender.render(frame, settings)
            for eye in EYES:
                a, b = getattr(ours, eye), getattr(theirs, eye)
                on_a, on_b = (seen.part_id == Part.TANKER for seen in (a, b))
                assert np.count_nonzero(on_a) > 100, name
                differ = a.part_id != b.part_id
                # Pixel centres on an edge may fall to either side: blades of a few pixels are all edge.
                share = np.count_nonzero(differ) / np.count_nonzero(a.part_id)
                assert share < (0.02 if name in PROPELLERS else 0.005), (name, share)
                edges = binary_dilation(a.part_id != np.roll(a.part_id, 1, axis=0)) | binary_dilation(
                    a.part_id != np.roll(a.part_id, 1, axis=1)
                )
                assert not (differ & ~binary_dilation(edges)).any(), name
                both = on_a & on_b
                light = [float((seen.radiance_cd_m2 @ REC709_LUMINANCE)[both].mean()) for seen in (a, b)]
                # The renderers' noise at four paths over some hundred pixels and more.
                assert light[0] == pytest.approx(light[1], rel=0.05), name
            for radiance in (ours, theirs):
                record = label_frame(frame, radiance, expose(frame, radiance))
                assert check_against_passes(record, radiance) == [], name
    finally:
        blender.close()
