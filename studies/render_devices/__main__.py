"""`python -m studies.render_devices`: compare two variants of Mitsuba, by default a GPU's with LLVM's.

Each variant renders the pairs in processes of its own.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import Recipe
from drogue_models.parts import MAX_MARKERS, drogue_part_ids
from droguekit.batch.execution import default_workers
from droguekit.batch.frame_cost import frames_per_second, warm_up_frames
from droguekit.batch.worker_pool import run_in_own_process
from droguekit.workflows.rendering import open_recipe
from geometry.stereo import EYES
from render.device import Device, query_gpu
from render.engine import engine_notice, load_engine
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
    noise = math.hypot(one.noise * _rms(first), other.noise * _rms(second))
    shown = (one.part_id > 0) | (other.part_id > 0)
    return PairAgreement(
        over_noise=_rms(second - first) / noise,
        mean_difference=float(second.sum() / first.sum() - 1),
        other_parts=float(np.mean(one.part_id[shown] != other.part_id[shown])),
    )


def agree(pairs: list[PairAgreement]) -> bool:
    """Whether two variants agree within noise on pairs, all together."""
    over_noise = _rms(np.array([pair.over_noise for pair in pairs]))
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


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


_RECIPE = str(files("droguekit.workflows") / "recipes" / "bench-corpus.toml")


def _agreement_lines(
    recipe: Recipe, frames: int, variants: Sequence[VariantName], verdict: list[bool]
) -> Iterator[str]:
    """Agreement by pair; appends whether all together agree within noise."""
    one, other = (rendered_pixels(recipe, frames, variant) for variant in variants)
    yield f"{variants[0]}: {one[0].engine_version}"
    yield f"{variants[1]}: {other[0].engine_version}"
    yield f"{'pair':>5} {'difference/noise':>17} {'mean [%]':>9} {'other part ids [%]':>19}"
    pairs = []
    for index, (first, second) in enumerate(zip(one, other, strict=True)):
        pair = compare_pair(first, second)
        if pair is not None:
            pairs.append(pair)
            shares = f"{100 * pair.mean_difference:+9.3f} {100 * pair.other_parts:19.4f}"
            yield f"{index:5d} {pair.over_noise:17.2f} {shares}"
    if not pairs:
        raise ValueError("--frames: none of them shows a drogue; give more")
    verdict.append(agree(pairs))
    limits = f"difference/noise {MOST_OVER_NOISE:g}, mean {100 * MOST_MEAN_DIFFERENCE:g} %"
    yield f"{'agree' if verdict[-1] else 'do not agree'} within noise (all pairs together; limits: {limits})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code is 1 where the variants do not agree within noise."""
    parser = argparse.ArgumentParser(prog="python -m studies.render_devices", description=__doc__)
    names = get_args(VariantName)
    parser.add_argument("--variants", nargs=2, choices=names, default=("llvm", "cuda"), metavar=("ONE", "OTHER"))
    parser.add_argument("--recipe", default=_RECIPE, help="name or file (default: the recipe of `bench`, 2 to 40 m)")
    parser.add_argument("--frames", type=int, default=8, metavar="N", help="pairs that are compared (default 8)")
    parser.add_argument("--pairs", type=int, default=100, metavar="N", help="pairs that are timed (default 100)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: as `render` has)")
    options = parser.parse_args(arguments)
    verdict: list[bool] = []
    try:
        if options.frames < 1 or options.pairs < 1 or (options.workers is not None and options.workers < 1):
            raise ValueError("--frames, --pairs, --workers: must be at least 1")
        for variant in options.variants:
            engine_notice("mitsuba", device_of(variant))
        recipe = open_recipe(options.recipe, None, "mitsuba").recipe
        if not options.frames <= recipe.frames.count:
            raise ValueError(f"--frames: the recipe has {recipe.frames.count}, got {options.frames}")
        for line in _agreement_lines(recipe, options.frames, options.variants, verdict):
            print(line, flush=True)
        for variant in options.variants:
            workers = options.workers or default_workers(device_of(variant))
            rate = render_rate(recipe, options.pairs, workers, variant)
            power = "power not known" if rate.power_w is None else f"GPU {rate.power_w:.0f} W"
            print(f"{variant}: {rate.pairs_per_s:.2f} pairs/s with {workers} workers, {power}", flush=True)
    except (ValueError, OSError) as error:
        print(f"render_devices: error: {error}", file=sys.stderr)
        return 2
    return 0 if all(verdict) else 1


if __name__ == "__main__":
    sys.exit(main())
