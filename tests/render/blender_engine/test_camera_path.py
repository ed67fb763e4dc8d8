"""Image windows of Blender's pictures."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe
from render.blender_engine.camera_path import EyePath
from scenes.sampler import sample_frame

LEAST_SIDE_PX = 4


@pytest.mark.parametrize("beyond_px", [(1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5), (1.5, 1.5), (-0.5, 0.5)])
def test_a_window_at_the_image_s_edge_is_as_large_as_blender_s_smallest_picture(beyond_px: tuple[float, float]) -> None:
    frame = sample_frame(load_recipe("smoke").recipe, 0)
    camera = frame.rig.camera
    size_px = np.array([camera.width_px, camera.height_px])
    side = np.sign(beyond_px)
    seen_px = np.where(side == 0, size_px / 2, np.where(side > 0, size_px - 1, 0)) + beyond_px
    ray = np.array([(seen_px[0] - camera.cx_px) / camera.fx_px, (seen_px[1] - camera.cy_px) / camera.fy_px, 1.0])
    path = EyePath(frame, "left", np.zeros((1, 3), np.float32))
    window = path.window(path.middle.apply(5.0 * ray[None]).astype(np.float32))
    assert window is not None
    assert min(window.width_px, window.height_px) >= LEAST_SIDE_PX
    # Parts of the image at its edge, and no larger than they need be.
    first = np.array([window.left_px, window.top_px])
    end = first + np.array([window.width_px, window.height_px])
    assert (first >= 0).all() and (end <= size_px).all()
    assert (end[side > 0] == size_px[side > 0]).all() and (first[side < 0] == 0).all()
    assert max(window.width_px, window.height_px) <= 6
