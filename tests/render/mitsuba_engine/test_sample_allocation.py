"""Rays of pixels with edges: how many, and where they go."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from datasets_manifest.random_streams import frame_generator
from drogue_models.parts import Part
from geometry.stereo import EYES
from render.engine import RenderEngine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import paper_view_recipe

if TYPE_CHECKING:
    from render.mitsuba_engine.paths.rays import StratifiedSamples

pytestmark = pytest.mark.mitsuba


class Bits:
    """Random bits as `FrameRays` gives them."""

    def __init__(self, seed: int) -> None:
        self._seeds = frame_generator(seed, 0, "test")

    def random_bits(self, kinds: int, pixels: int) -> np.ndarray:
        return self._seeds.integers(2**32, size=(kinds, pixels), dtype=np.uint32)


@pytest.fixture
def place(engine: RenderEngine) -> type[StratifiedSamples]:
    from render.mitsuba_engine.paths.rays import StratifiedSamples

    return StratifiedSamples


@pytest.fixture
def counts_of(engine: RenderEngine) -> Callable[..., Any]:
    from render.mitsuba_engine.render_noise import counts_by_variance

    return counts_by_variance


def of_pixel(samples: StratifiedSamples, pixel: int) -> tuple[np.ndarray, np.ndarray]:
    rows = np.array(samples.pixel) == pixel
    return np.array(samples.place).T[rows], np.array(samples.moment)[rows]


@pytest.mark.parametrize("count", [16, 64, 1024])
def test_every_rectangle_of_a_samples_size_has_one(place: type[StratifiedSamples], count: int) -> None:
    samples = place(Bits(1), np.array([7, 30]), np.array([32, count]))
    places, _ = of_pixel(samples, 30)
    for power in range(count.bit_length()):
        columns, rows = 2**power, count // 2**power
        cell = np.floor(places * (columns, rows)).astype(int)
        assert len(np.unique(cell @ (1, columns))) == count


def test_moments_are_even_in_every_part_of_a_pixel(place: type[StratifiedSamples]) -> None:
    places, moments = of_pixel(place(Bits(2), np.array([3]), np.array([256])), 3)
    assert len(np.unique(np.floor(moments * 256))) == 256
    # The first three numbers of the sequence put two samples into each box of two samples' size.
    box = np.floor(np.column_stack([places * (4, 4), moments * 8])).astype(int) @ (1, 4, 16)
    assert set(np.bincount(box, minlength=128)) == {2}


def test_numbers_are_those_of_sobol(engine: RenderEngine) -> None:
    import drjit as dr
    import mitsuba as mi
    from scipy.stats.qmc import Sobol

    from render.mitsuba_engine.paths.rays import _sobol

    index = dr.arange(mi.UInt32, 64)
    ours = np.stack([np.array(dr.brev(index)), np.array(_sobol(index, (1,))), np.array(_sobol(index, (1, 3)))], axis=1)
    # SciPy goes through the sequence in another order, by Gray's code.
    gray = np.arange(64) ^ np.arange(64) >> 1
    assert np.array_equal(ours[gray] / 2**32, Sobol(3, scramble=False).random(64))


def test_means_are_those_of_each_pixel(place: type[StratifiedSamples]) -> None:
    counts = np.array([16, 64, 16, 512])
    samples = place(Bits(3), np.array([5, 9, 2, 40]), counts)
    means = samples.means([samples.place.x * 1.0, samples.place.y * 1.0])
    for row, pixel in enumerate((5, 9, 2, 40)):
        assert means[row] == pytest.approx(of_pixel(samples, pixel)[0].mean(axis=0), rel=1e-5)


def test_error_on_an_edge_goes_with_the_count_to_the_power_of_three_quarters(place: type[StratifiedSamples]) -> None:
    rng = np.random.default_rng(4)
    direction = rng.uniform(0, 2 * np.pi, 2000)
    normal, through = np.stack([np.cos(direction), np.sin(direction)], axis=1), rng.uniform(0.2, 0.8, (2000, 2))
    errors = []
    for count in (16, 256):
        samples = place(Bits(5), np.arange(2000), np.full(2000, count))
        places = np.array(samples.place).T.reshape(2000, count, 2)
        covered = (np.einsum("pci,pi->pc", places - through[:, None], normal) > 0).mean(axis=1)
        errors.append(covered)
    settled = place(Bits(6), np.arange(2000), np.full(2000, 1024))
    places = np.array(settled.place).T.reshape(2000, 1024, 2)
    truth = (np.einsum("pci,pi->pc", places - through[:, None], normal) > 0).mean(axis=1)
    rms = [np.sqrt(np.mean((covered - truth) ** 2)) for covered in errors]
    # 16 times the samples: an eighth of the error, and the settled compositor's own error in the second.
    assert rms[1] / rms[0] == pytest.approx(16**-0.75, rel=0.3)
    # No side is preferred.
    assert np.mean(errors[0] - truth) == pytest.approx(0.0, abs=4 * rms[0] / np.sqrt(2000))


def test_counts_bring_the_error_that_is_allowed(counts_of: Callable[..., Any]) -> None:
    variance = np.random.default_rng(7).lognormal(0.0, 2.0, 5000)
    judged = np.arange(5000) % 2 == 0
    counts = counts_of(variance, judged, 5.0, 1e9)
    assert set(np.log2(counts) % 1) == {0.0}
    # By the law of errors that the counts go by; rounding to powers of two and their bounds change it a little.
    assert np.sum(0.7 * variance[judged] * counts[judged] ** -1.5) == pytest.approx(5.0, rel=0.3)


def test_counts_stay_within_what_may_be_taken(counts_of: Callable[..., Any]) -> None:
    variance = np.random.default_rng(8).lognormal(0.0, 1.0, 5000)
    counts = counts_of(variance, np.ones(5000, dtype=bool), 1e-9, 100.0)
    assert np.mean(counts) == pytest.approx(100.0, rel=0.1)


def test_even_pixels_take_the_fewest_rays(counts_of: Callable[..., Any]) -> None:
    assert set(counts_of(np.zeros(9), np.ones(9, dtype=bool), 1.0, 100.0)) == {16}


def test_rays_that_agree_do_not_prove_a_pixel_even(engine: RenderEngine) -> None:
    """Nine rays miss what fills a twentieth of a pixel three times in five."""
    from render.compositing import Compositor, TracedEye
    from render.mitsuba_engine.render_noise import NoiseBudget

    frame = sample_frame(paper_view_recipe(scale=0.1), 0)
    shape = (frame.rig.camera.height_px, frame.rig.camera.width_px)
    face = np.full(shape, int(Part.FACE), dtype=np.uint8)
    depth = np.full(shape, 30.0, dtype=np.float32)
    seen = TracedEye.untraced(part_id=face, depth_m=depth, normal=np.zeros((*shape, 3)), amodal_px={})
    bright = np.full((*shape, 3), 10_000.0, dtype=np.float32)
    compositor = Compositor(frame, dict.fromkeys(EYES, seen), dict.fromkeys(EYES, bright))
    # Every third pixel of some rows: none is another's neighbour.
    pixel = np.concatenate([np.arange(0, shape[1], 3) + row * shape[1] for row in (0, 5, 10, 15)])
    found = np.zeros((len(pixel), 9, 7), dtype=np.float32)
    found[..., :3], found[..., 3] = 200.0, 1.0
    found[::2, ::2, :4] = 0.0
    inside = pixel[:4], np.repeat(found[1:2, 0], 4, axis=0)
    counts = NoiseBudget(compositor, (pixel, found), inside, 0.1).edge_counts(512)
    torn, agreeing = counts[::2], counts[1::2]
    assert len(np.unique(torn)) == len(np.unique(agreeing)) == 1
    # A hundredth of the mean variance, and to the power of 0.4: an eighth of the rays, which are powers of two.
    assert torn[0] // 16 <= agreeing[0] <= torn[0] // 4
    assert agreeing[0] > 16
