"""`python -m studies.render_devices`: compare two variants of Mitsuba, by default a GPU's with LLVM's."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import get_args

from datasets_manifest.recipe.recipe import Recipe
from droguekit.batch.execution import default_workers
from droguekit.workflows.rendering import open_recipe
from render.engine import engine_notice
from studies.render_devices.variant_comparison import (
    MOST_MEAN_DIFFERENCE,
    MOST_OVER_NOISE,
    VariantName,
    agree,
    compare_pair,
    device_of,
    render_rate,
    rendered_pixels,
)

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
