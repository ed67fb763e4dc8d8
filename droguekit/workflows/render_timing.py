"""How fast pairs are rendered: the recipes by which it is measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droguekit.workflows.rendering import open_recipe

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import Recipe

_BENCH_STATIONS_M = (2.0, 5.0, 10.0, 20.0, 40.0)


_BENCH_SCENES = 8


_BENCH_SAMPLES: dict[str, dict[str, float]] = {
    "corpus": {"samples_per_px": 16, "open_samples_per_px": 4, "edge_samples_per_px": 324},
    "benchmark": {
        "samples_per_px": 64,
        "open_samples_per_px": 8,
        "edge_samples_per_px": 400,
        "noise_over_sensor": 0.3,
    },
}


BENCH_QUALITIES = tuple(_BENCH_SAMPLES)


def open_bench_recipe(repeat: int, engine: str | None) -> Recipe:
    """The recipe by which speed is measured: `repeat` full-size pairs at each of five distances.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if repeat < 1:
        raise ValueError(f"--repeat: must be at least 1, got {repeat}")
    distance: dict[str, object] = {"law": "stations", "stations_m": _BENCH_STATIONS_M}
    return _bench_recipe({"count": repeat * len(_BENCH_STATIONS_M)}, distance, "corpus", engine)


def open_uniform_bench_recipe(pairs: int, quality: str, engine: str | None) -> Recipe:
    """The recipe by which a corpus's mean speed and noise are measured: distances uniform from 2 to 40 m, some scenes.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if pairs < 1:
        raise ValueError(f"--pairs: must be at least 1, got {pairs}")
    distance: dict[str, object] = {"law": "uniform", "low_m": _BENCH_STATIONS_M[0], "high_m": _BENCH_STATIONS_M[-1]}
    # One sky has up to two and a half times the noise of another.
    frames = {"count": pairs, "scenes": min(pairs, _BENCH_SCENES)}
    return _bench_recipe(frames, distance, quality, engine)


def _bench_recipe(frames: dict[str, int], distance: dict[str, object], quality: str, engine: str | None) -> Recipe:
    from datasets_manifest.recipe.recipe import Recipe

    demo = open_recipe("demo", None, engine).recipe
    changes = {
        "frames": frames,
        "distance": distance,
        "render": {**demo.render.model_dump(), **_BENCH_SAMPLES[quality]},
    }
    return Recipe.model_validate({**demo.model_dump(), **changes})
