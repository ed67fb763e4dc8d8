"""Renders against a stored mean and variance of many renders: what no closed form covers.

After a change that is meant to change radiance, make the stored file anew and look at what changed:

    .venv/bin/python tests/render/test_golden_render.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from geometry.stereo import EYES
from render.engine import RenderEngine, load_engine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.render.golden_frame import GOLDEN, golden_recipe

pytestmark = pytest.mark.mitsuba

RENDERS, MORE_RENDERS = 200, 60
RENDER = {"edge_samples_per_px": 64, "denoise": False}


def luminance(engine: RenderEngine, index: int) -> np.ndarray:
    """(2, H, W) luminance of both eyes by the samples of seed `index`."""
    recipe = golden_recipe(**RENDER)
    frame = sample_frame(recipe, 0).model_copy(update={"seed": index})
    radiance = engine.render(frame, recipe.render)
    return np.stack([getattr(radiance, eye).radiance_cd_m2 @ REC709_LUMINANCE for eye in EYES])


def stored_parts(engine: RenderEngine) -> np.ndarray:
    recipe = golden_recipe(**RENDER)
    radiance = engine.render(sample_frame(recipe, 0), recipe.render)
    return np.stack([getattr(radiance, eye).part_id for eye in EYES])


def write_failure(folder: Path, image: np.ndarray, mean: np.ndarray, z: np.ndarray) -> Path:
    """The render, what was expected and z from -5 to 5, side by side for each eye."""
    peak = mean.max()
    rows = [np.hstack([image[i] / peak, mean[i] / peak, z[i] / 10 + 0.5]) for i in range(2)]
    path = folder / "golden_render.png"
    cv2.imwrite(str(path), np.clip(np.vstack(rows) * 255, 0, 255).astype(np.uint8))
    return path


def test_render_is_a_draw_from_the_stored_distribution(engine: RenderEngine, tmp_path: Path) -> None:
    with np.load(GOLDEN) as stored:
        mean, variance, parts = stored["mean"].astype(float), stored["variance"].astype(float), stored["parts"]
        usual, scatter = stored["mean_square"]
    image = luminance(engine, 5000)
    # The stored mean has an error of its own; float32 and interpolation differ by 1e-4 between machines.
    spread = np.sqrt(variance * (1 + 1 / RENDERS) + (1e-4 * mean) ** 2)
    z = (image - mean) / spread
    # Where no path goes is the background, which has tests of its own.
    traced = variance > (1e-3 * mean) ** 2
    failed = f"see {write_failure(tmp_path, image, mean, z)}"
    square, count = mean_square(image, mean, variance)
    assert count > 500, failed
    # Errors on edges are far from normal: the mean square and its scatter were measured on renders of their own.
    assert square == pytest.approx(usual, abs=4 * scatter), failed
    # Edge pixels have skewed errors; beyond 8 standard deviations are fewer than two in a thousand.
    assert np.mean(np.abs(z[traced]) > 8) < 2e-3, failed
    for part in np.unique(parts):
        of_part = traced & (parts == part)
        total = (image - mean)[of_part].sum() / np.sqrt(
            (spread[of_part] ** 2).sum() + (1e-4 * mean[of_part].sum()) ** 2
        )
        # One in fifteen thousand for each of some 15 parts.
        assert abs(total) < 4, f"part {part}: {total:.1f} standard errors; {failed}"


def mean_square(image: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """Mean square of z over the pixels that have noise worth the name, and how many those are."""
    noisy = variance > (1e-3 * mean) ** 2
    return np.mean((image - mean)[noisy] ** 2 / variance[noisy]), noisy.sum()


def make_golden() -> None:
    """Mean and variance of many renders, each by other samples, and what mean square of z others have against them."""
    engine = load_engine("mitsuba")
    images = np.stack([luminance(engine, index) for index in range(RENDERS + MORE_RENDERS)])
    images, others = images[:RENDERS], images[RENDERS:]
    mean, variance = images.mean(axis=0), images.var(axis=0, ddof=1)
    squares = [mean_square(image, mean, variance)[0] for image in others]
    np.savez_compressed(
        GOLDEN,
        mean=mean.astype(np.float32),
        variance=variance.astype(np.float32),
        mean_square=[np.mean(squares), np.std(squares, ddof=1)],
        parts=stored_parts(engine),
    )


if __name__ == "__main__":
    make_golden()
