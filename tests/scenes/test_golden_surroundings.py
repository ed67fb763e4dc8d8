"""Ground and clouds as a camera that does not fly sees them, against stored values: single pairs stay as they are.

After a change that is meant to change them, make the stored file anew and look at what changed:

    .venv/bin/python tests/scenes/test_golden_surroundings.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer, Environment
from scenes.clouds.cloud_layers import CloudLight, opacity_towards, render_cloud_layer
from scenes.ground.ground_radiance import MEAN_REFLECTANCE, Ground
from scenes.ground.sea import GroundLight

GOLDEN = Path(__file__).parent / "golden_surroundings.npz"
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 30.0, 24, 16
TO_SUN = np.array([0.6, 0.0, 0.8])
CLOUDS = {
    "cumulus": {"cover_fraction": 0.5, "thickness_m": 300.0, "optical_depth": 10.0},
    "stratus": {"cover_fraction": 0.9, "thickness_m": 300.0, "optical_depth": 4.0},
    "congestus": {"cover_fraction": 0.4, "thickness_m": 900.0, "optical_depth": 20.0},
    "altocumulus": {"cover_fraction": 0.6, "thickness_m": 300.0, "optical_depth": 4.0},
    "cirrus": {"cover_fraction": 0.7, "optical_depth": 0.5},
    "contrail": {"cover_fraction": 0.7, "optical_depth": 0.5},
    "rain": {"cover_fraction": 0.4, "optical_depth": 0.5},
}


def looking(up: float) -> np.ndarray:
    """(H, W, 3) directions of a pinhole that looks east, and so many metres up in each."""
    u, v = np.meshgrid(np.arange(WIDTH_PX) - WIDTH_PX / 2 + 0.5, np.arange(HEIGHT_PX) - HEIGHT_PX / 2 + 0.5)
    rays = np.stack([np.full_like(u, FOCAL_PX), -u, up * FOCAL_PX - v], axis=-1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def ground(kind: str) -> np.ndarray:
    environment = Environment(
        sun_elevation_deg=53.13,
        sun_azimuth_deg=0.0,
        turbidity=2.5,
        visibility_m=50_000.0,
        altitude_m=1500.0,
        ground=kind,
        ground_reflectance_rgb=MEAN_REFLECTANCE[kind],
        # On the coast of this one land and sea are seen.
        ground_texture_seed=2,
    )
    light = GroundLight(np.full(3, 6e3), TO_SUN, np.full(3, 6e4), lambda rays: np.full_like(rays, 2e3))
    return Ground(environment, light).radiance(looking(-1.0))


def cloud(kind: str) -> np.ndarray:
    """(H, W, 4) light times opacity, and opacity."""
    layer = CloudLayer.model_validate(
        {"kind": kind, "height_above_camera_m": 1200.0, "feature_size_m": 900.0, "texture_seed": 4} | CLOUDS[kind]
    )
    light = CloudLight(TO_SUN, np.full(3, 6e4), np.full(3, 6e3), np.full(3, 2e3))
    seen = render_cloud_layer(layer, looking(1.0), light)
    towards_sun = np.full((1, WIDTH_PX, 4), opacity_towards(layer, TO_SUN), dtype=np.float32)
    picture = np.concatenate([seen.radiance * seen.opacity[..., None], seen.opacity[..., None]], axis=-1)
    return np.concatenate([picture, towards_sun])


def pictures() -> dict[str, np.ndarray]:
    return {kind: ground(kind) for kind in MEAN_REFLECTANCE} | {kind: cloud(kind) for kind in CLOUDS}


@pytest.mark.parametrize("kind", [*MEAN_REFLECTANCE, *CLOUDS])
def test_they_look_as_they_did(kind: str) -> None:
    found = cloud(kind) if kind in CLOUDS else ground(kind)
    with np.load(GOLDEN) as stored:
        expected = stored[kind]
    # Of the largest value: with NumPy and OpenCV held to older instructions it is 4e-7, a few bits of float32.
    for channel in range(expected.shape[-1]):
        most = float(np.abs(expected[..., channel]).max())
        np.testing.assert_allclose(found[..., channel], expected[..., channel], rtol=0, atol=1e-6 * most)


if __name__ == "__main__":
    np.savez_compressed(GOLDEN, **pictures())
