"""What every engine delivers, and how to get one by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import RenderSettings


class EngineUnavailableError(ValueError):
    """An engine that is unknown or not installed; says what to do."""


@dataclass(frozen=True, eq=False)
class EyeRadiance:
    """What one eye would see with a perfect lens, and the passes of its pixel centres.

    Attributes:
        radiance_cd_m2: (H, W, 3) float32, linear Rec. 709, scaled so that 0.2126 R + 0.7152 G + 0.0722 B is the
            luminance. [cd/m2]
        coverage: (H, W) float32, share of the pixel's box that any part covers.
        part_id: (H, W) uint8, `drogue_models.parts`, by the ray through the pixel centre at mid-exposure.
        depth_m: (H, W) float32, planar depth along that ray, inf for the sky. [m]
        normal: (H, W, 3) float32, unit normal in the eye's frame along that ray, 0 for the sky.
        amodal_px: by part id (markers and hub), the pixel centres it would cover if nothing stood before it.
    """

    radiance_cd_m2: NDArray[np.float32]
    coverage: NDArray[np.float32]
    part_id: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    amodal_px: dict[int, int]


@dataclass(frozen=True, eq=False)
class StereoRadiance:
    """Both eyes of one frame.

    Attributes:
        engine, engine_version: what made it, down to the variant.
        monte_carlo_noise_fraction: relative standard error of a pixel's luminance inside the drogue's parts, root mean
            square over the pixels, estimated from the spread of each pixel's samples as if they were independent (they
            are better than that); 0 for an engine without sampling.
        stage_s: CPU seconds by stage. [s]
    """

    left: EyeRadiance
    right: EyeRadiance
    engine: str
    engine_version: str
    monte_carlo_noise_fraction: float
    stage_s: dict[str, float]


class RenderEngine(Protocol):
    """Makes radiance. One engine lives in one process and is reused for many frames."""

    name: str
    version: str

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes."""
        ...


def engine_names() -> tuple[str, ...]:
    """Engines that this version knows."""
    return ("mitsuba", "analytic")


def engine_notice(name: str) -> str | None:
    """What the user should know before the engine starts, in one line: that it will be slow, and why.

    Raises:
        ValueError: the engine's packages are missing.
    """
    if name != "mitsuba":
        return None
    from render.mitsuba_engine.variant import probe_variant

    variant = probe_variant()
    return None if variant.library is not None else f"engine mitsuba runs as {variant.variant}: {variant.reason}"


def load_engine(name: str) -> RenderEngine:
    """The engine named `name`, ready to render.

    Raises:
        EngineUnavailableError: no such engine, or its packages are missing.
    """
    if name not in engine_names():
        raise EngineUnavailableError(f"engine: no engine named {name!r}; there are {', '.join(engine_names())}")
    if name == "analytic":
        from render.analytic_engine.engine import AnalyticEngine

        return AnalyticEngine()
    from render.mitsuba_engine.engine import MitsubaEngine

    return MitsubaEngine()
