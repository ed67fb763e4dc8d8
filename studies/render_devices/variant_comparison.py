"""Renders pairs by the variants of Mitsuba, each in processes of its own, and compares them."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import Recipe
from drogue_models.parts import MAX_MARKERS, drogue_part_ids
from droguekit.batch.frame_cost import frames_per_second, warm_up_frames
from droguekit.batch.worker_pool import run_in_own_process
from droguekit.scoring.confidence_intervals import root_mean_square
from geometry.stereo import EYES
from render.device import Device, query_gpu
from render.engine import load_engine
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE

VariantName = Literal["llvm", "scalar", "cuda"]
MOST_OVER_NOISE = 1.5
"""Above this the difference of two variants is more than their noise: 1 is expected, and the noise is an estimate."""
MOST_MEAN_DIFFERENCE = 0.005
"""Largest difference of the mean luminance on the drogue over all pairs, relative."""
_POWER_EVERY_S = 0.5
_DROGUE = drogue_part_ids(MAX_MARKERS)


@dataclass(frozen=True, eq=False)
class RenderedPixels:
    """One pair by one variant.

    Attributes:
        engine_version: of the variant.
        luminance: (2, H, W) of both eyes. [cd/m2]
        part_id: (2, H, W).
        noise: root mean square error of luminance by sampling on the drogue, over its root mean square.
    """

    engine_version: str
    luminance: NDArray[np.float32]
    part_id: NDArray[np.uint8]
    noise: float


@dataclass(frozen=True)
class PairAgreement:
    """How far two variants agree on one pair.

    Attributes:
        over_noise: root mean square difference of luminance on the drogue, over the noise of both together.
        mean_difference: of the second variant's luminance there from the first's, relative.
        other_parts: share of the pixels with another part id, among those that show anything.
    """

    over_noise: float
    mean_difference: float
    other_parts: float


@dataclass(frozen=True)
class RenderRate:
    """Speed of a variant.

    Attributes:
        pairs_per_s: by the clock, of all workers together.
        power_w: of the GPU meanwhile, None where it is not known. [W]
    """

    pairs_per_s: float
    power_w: float | None


def device_of(variant: VariantName) -> Device:
    """The device that a variant runs on."""
    return "cuda" if variant == "cuda" else "cpu"


@contextmanager
def chosen_variant(variant: VariantName) -> Iterator[Device]:
    """Processes that start meanwhile use this variant on the device that is given."""
    kept = os.environ.get("DRJIT_LIBLLVM_PATH")
    if variant == "scalar":
        # Without the library the processor's other variant is left.
        os.environ["DRJIT_LIBLLVM_PATH"] = "/nonexistent/libLLVM.so"
    try:
        yield device_of(variant)
    finally:
        if variant == "scalar":
            os.environ.pop("DRJIT_LIBLLVM_PATH")
            if kept is not None:
                os.environ["DRJIT_LIBLLVM_PATH"] = kept


def rendered_pixels(recipe: Recipe, frames: int, variant: VariantName) -> list[RenderedPixels]:
    """The first frames of a recipe by one variant.

    Raises:
        ValueError: the variant cannot be used here.
    """
    with chosen_variant(variant) as device:
        found = run_in_own_process(partial(_render, recipe, frames, device))
    if f" {variant}_" not in found[0].engine_version:
        raise ValueError(f"{variant}: is not here; the engine runs as {found[0].engine_version}")
    return found


def _render(recipe: Recipe, frames: int, device: Device) -> list[RenderedPixels]:
    engine = load_engine("mitsuba", device)
    found = []
    for index in range(frames):
        radiance = engine.render(sample_frame(recipe, index), recipe.render)
        eyes = [radiance.left if eye == "left" else radiance.right for eye in EYES]
        luminance = np.stack([eye.radiance_cd_m2 @ REC709_LUMINANCE.astype(np.float32) for eye in eyes])
        part_id = np.stack([eye.part_id for eye in eyes])
        found.append(RenderedPixels(engine.version, luminance, part_id, radiance.monte_carlo_noise_fraction))
    return found


def compare_pair(one: RenderedPixels, other: RenderedPixels) -> PairAgreement | None:
    """Agreement of two variants on a pair; None where it shows no drogue."""
    drogue = np.isin(one.part_id, _DROGUE) & np.isin(other.part_id, _DROGUE)
    if not drogue.any():
        return None
    first, second = (pixels.luminance[drogue].astype(np.float64) for pixels in (one, other))
    noise = math.hypot(one.noise * root_mean_square(first), other.noise * root_mean_square(second))
    shown = (one.part_id > 0) | (other.part_id > 0)
    return PairAgreement(
        over_noise=root_mean_square(second - first) / noise,
        mean_difference=float(second.sum() / first.sum() - 1),
        other_parts=float(np.mean(one.part_id[shown] != other.part_id[shown])),
    )


def agree(pairs: list[PairAgreement]) -> bool:
    """Whether two variants agree within noise on pairs, all together."""
    over_noise = root_mean_square(np.array([pair.over_noise for pair in pairs]))
    mean_difference = abs(float(np.mean([pair.mean_difference for pair in pairs])))
    return over_noise <= MOST_OVER_NOISE and mean_difference <= MOST_MEAN_DIFFERENCE


def render_rate(recipe: Recipe, pairs: int, workers: int, variant: VariantName) -> RenderRate:
    """Pairs a second by the clock, with optics, labels, encoding and files, and the GPU's power meanwhile.

    Raises:
        ValueError: the variant cannot be used here, or a frame cannot be made.
        OSError: a process died again and again, or the temporary folder cannot be written.
    """
    frames = recipe.frames.model_copy(update={"count": pairs + warm_up_frames(workers)})
    longer = Recipe.model_validate(dict(recipe) | {"frames": frames})
    watts, ended = list[float](), threading.Event()

    def watch() -> None:
        while not ended.wait(_POWER_EVERY_S):
            power_w = query_gpu("power.draw")
            if power_w is None:
                return
            watts.append(power_w)

    watcher = threading.Thread(target=watch, daemon=True)
    with chosen_variant(variant) as device:
        if device == "cuda":
            watcher.start()
        try:
            rate = frames_per_second(longer, workers, device)
        finally:
            ended.set()
    return RenderRate(rate, float(np.mean(watts)) if watts else None)
