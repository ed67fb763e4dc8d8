"""Image windows of objects behind lenses against the pixels that show them."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig
from render.camera.exposure_motion import image_window


# Barrels, of which the last is bent by its tangential terms too; and a cushion.
@pytest.mark.parametrize(
    ("focal_px", "distortion"),
    [
        (800.0, BrownConrady(k1=-0.14)),
        (1000.0, BrownConrady(k1=-0.2, p1=5e-3)),
        (800.0, BrownConrady(k1=0.2)),
    ],
)
def test_the_window_of_an_object_holds_the_pixel_that_shows_it(focal_px: float, distortion: BrownConrady) -> None:
    camera = PinholeCamera(1280, 960, focal_px, focal_px, 639.5, 479.5)
    lens = Lens(camera, distortion)
    rig = StereoRig(camera, 0.12, lenses=(lens, lens))
    for place in ([5.0, 5.0], [1274.0, 954.0], [20.0, 20.0], [5.0, 480.0], [640.0, 954.0], [700.0, 500.0]):
        corners_m = rig.rays(place, "left") * 20 + np.random.default_rng(0).uniform(-0.02, 0.02, (8, 3))
        window = image_window(rig, [RigidTransform.identity()], corners_m)
        assert window is not None, place
        seen = rig.image(corners_m, "left")
        first, end = window
        assert (first <= np.maximum(np.floor(seen.min(axis=0)), 0)).all()
        assert (end > np.minimum(np.ceil(seen.max(axis=0)), [1279, 959])).all()
