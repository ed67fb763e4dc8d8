"""Outlines that the page draws through lenses, against the rig's own projection."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from droguekit.visualization.browse import page as browse_page
from geometry.circles import disc_outline
from geometry.distortion import BrownConrady, Lens, OpenCvDistortion
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_twist, rotation_from_angles
from geometry.stereo import EYES, StereoRig, paper_rig

OpenPage = Callable[..., Any]

SHORT = (-0.08, 0.03, 2e-4, -1e-4, 0.01)
MODELS = {
    "brown-conrady": BrownConrady(*SHORT),
    "rational": OpenCvDistortion(*SHORT, 0.02, -0.01, 0.003),
    "tilted": OpenCvDistortion(*SHORT, 0.02, -0.01, 0.003, 1e-3, -5e-4, -8e-4, 3e-4, 0.02, -0.03),
}


def script_page(folder: Path) -> Path:
    """A page with the script alone."""
    script = Path(browse_page.__file__).parent / "site" / "projection.js"
    page = folder / "page.html"
    page.write_text(f"<!DOCTYPE html><html lang='en'><title>t</title><script>{script.read_text()}</script></html>")
    return page


@pytest.mark.parametrize("name", [None, *MODELS])
def test_a_ring_lies_where_the_rig_sees_it(name: str | None, open_page: OpenPage, tmp_path: Path) -> None:
    ideal = paper_rig()
    lenses = None
    if name is not None:
        turn = exp_twist([0, 0, 0, 0.003, -0.004, 0.005]).rotation
        camera = PinholeCamera(1280, 960, 2130.0, 2131.0, 645.0, 472.0)
        lenses = Lens(camera, MODELS[name]), Lens(camera, MODELS[name], turn)
    rig = StereoRig(ideal.camera, ideal.baseline_m, lenses=lenses)
    pose = RigidTransform(rotation_from_angles(0.2, -0.3, 0.4), np.array([0.3, -0.2, 2.9]))
    center_m, radius_m, points = np.array([0.27, 0.05, 0.0]), 0.1, 16
    ring = {"center_m": center_m.tolist(), "radius_m": radius_m, "points": points}
    opened = open_page(script_page(tmp_path))
    for eye in EYES:
        found = opened.page.evaluate(
            "([rig, eye, pose, ring]) => droguekit.ringImage(rig, eye, pose, ring)",
            [browse_page._rig_table(rig), eye, pose.as_matrix()[:3].ravel().tolist(), ring],
        )
        wanted = rig.image(disc_outline(pose, center_m, radius_m, points), eye)
        # Double precision on both sides; outlines may begin at another place of the ring.
        gaps = np.linalg.norm(np.array(found)[:, None] - wanted[None], axis=-1)
        assert gaps.min(axis=1).max() < 1e-8
    assert opened.faults == []


def test_a_ring_far_aside_is_not_folded_into_the_image(open_page: OpenPage, tmp_path: Path) -> None:
    # The lens folds at a tangent of 1 / sqrt(1.5); a point at 1.5 would come out near the axis.
    camera = PinholeCamera(320, 240, 533.0, 533.0, 159.5, 119.5)
    lens = Lens(camera, BrownConrady(k1=-0.5))
    rig = StereoRig(camera, 0.12, lenses=(lens, lens))
    pose, center_m = RigidTransform(np.eye(3), np.array([4.2, 0.0, 3.0])), np.zeros(3)
    ring = {"center_m": center_m.tolist(), "radius_m": 0.1, "points": 16}
    folded = rig.lens("left").project_rays(disc_outline(pose, center_m, 0.1, 16))
    assert camera.contains(folded).any()
    opened = open_page(script_page(tmp_path))
    for eye in EYES:
        found = opened.page.evaluate(
            "([rig, eye, pose, ring]) => droguekit.ringImage(rig, eye, pose, ring)",
            [browse_page._rig_table(rig), eye, pose.as_matrix()[:3].ravel().tolist(), ring],
        )
        assert not camera.contains(np.array(found)).any()
    assert opened.faults == []
