"""The interface of render engines, their result types, and loading an engine by name."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from datasets_manifest.types.frame import FrameSpec
from render.device import DEVICES, Device

ENTRY_POINT_GROUP = "droguekit.engines"
"""Entry points of other packages for their engines: classes whose constructor takes no arguments."""

_OURS = ("mitsuba", "analytic", "blender")
_ON_GPU = ("mitsuba", "blender")


class EngineUnavailableError(ValueError):
    """An engine is unknown or not installed; the message says what to do."""


@dataclass(frozen=True, eq=False)
class EyeRadiance:
    """What one eye sees through a perfect lens, and the passes of its pixel centres.

    Attributes:
        radiance_cd_m2: (H, W, 3) float32, linear Rec. 709, scaled so that 0.2126 R + 0.7152 G + 0.0722 B is the
            luminance. [cd/m2]
        coverage: (H, W) float32, share of the pixel's box that any part covers.
        part_id: (H, W) uint8, `drogue_models.parts`, by the ray through the pixel centre at mid-exposure.
        depth_m: (H, W) float32, planar depth along that ray, inf for the sky. [m]
        normal: (H, W, 3) float32, unit normal in the eye's frame along that ray, 0 for the sky.
        amodal_px: by part id (markers and hub), number of pixel centres it would cover if nothing occluded it.
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
        engine, engine_version: what rendered it, down to the variant.
        monte_carlo_noise_fraction: root mean square error of luminance by the engine's sampling, over root mean square
            luminance, on the pixels of the drogue; 0 for an engine without sampling.
        stage_s: CPU seconds by stage. [s]
        monte_carlo_over_sensor_noise: the same error in the sensor's electrons, over the standard deviation of its shot
            and read noise on the same pixels, both behind the lens; None for an engine that does not measure it.
    """

    left: EyeRadiance
    right: EyeRadiance
    engine: str
    engine_version: str
    monte_carlo_noise_fraction: float
    stage_s: dict[str, float]
    monte_carlo_over_sensor_noise: float | None = None


class RenderEngine(Protocol):
    """Renders radiance. One engine lives in one process and renders many frames."""

    name: str
    version: str

    def render(self, frame: FrameSpec, settings: RenderSettings) -> StereoRadiance:
        """Radiance and passes of both eyes."""
        ...


def engine_names() -> tuple[str, ...]:
    """Engines that ship with this version, then those of other packages."""
    return (*_OURS, *sorted(_others()))


def engine_notice(name: str, device: Device = "cpu") -> str | None:
    """A line for the user before the engine starts: that it will be slow, and why; None otherwise.

    Raises:
        EngineUnavailableError: its packages are missing, or it cannot use the device.
        ValueError: no such device.
    """
    _check_device(name, device)
    if name == "blender":
        from render.blender_engine.interpreter import find_blender

        find_blender()
        if device != "cpu":
            from render.blender_engine.process import BlenderProcess

            BlenderProcess(device=device).close()
    if name != "mitsuba":
        return None
    from render.mitsuba_engine.variant import probe_variant

    variant = probe_variant(device)
    return None if variant.variant != "scalar_rgb" else f"engine mitsuba runs as {variant.variant}: {variant.reason}"


def crash_advice(name: str) -> str:
    """What to do where the engine's native code ends its process again and again; empty where nothing is known."""
    if name != "mitsuba":
        return ""
    from render.mitsuba_engine.variant import kernel_cache

    return f"; if it stays so, delete {kernel_cache()}, its cache of compiled kernels, which may be damaged"


def has_compiled(name: str, device: Device = "cpu") -> bool:
    """Whether a process that begins finds the engine's compiled code, or needs none; else one should go first."""
    if name != "mitsuba":
        return True
    from render.mitsuba_engine.variant import has_kernels, probe_variant

    return has_kernels(probe_variant(device))


def _check_device(name: str, device: Device) -> None:
    if device not in DEVICES:
        raise ValueError(f"device: must be {' or '.join(DEVICES)}, got {device!r}")
    if device != "cpu" and name not in _ON_GPU:
        raise EngineUnavailableError(
            f"device {device}: engine {name} renders on the processor only; take device cpu or engine "
            f"{' or '.join(_ON_GPU)}"
        )


def load_engine(name: str, device: Device = "cpu") -> RenderEngine:
    """The engine named `name`, ready to render.

    Args:
        name: of the engine.
        device: that it renders on.

    Raises:
        EngineUnavailableError: no such engine, its packages are missing, or it cannot use the device.
        ValueError: no such device.
    """
    if name not in engine_names():
        raise EngineUnavailableError(f"engine: no engine named {name!r}; there are {', '.join(engine_names())}")
    _check_device(name, device)
    if name not in _OURS:
        return _loaded(_others()[name])
    if name == "analytic":
        from render.analytic_engine.analytic_engine import AnalyticEngine

        return AnalyticEngine()
    if name == "blender":
        from render.blender_engine.blender_engine import BlenderEngine

        return BlenderEngine(device)
    from render.mitsuba_engine.mitsuba_engine import MitsubaEngine

    return MitsubaEngine(device)


def _others() -> dict[str, EntryPoint]:
    """Engines of other packages; they cannot replace an engine that ships with this version."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.name not in _OURS}


def _loaded(entry: EntryPoint) -> RenderEngine:
    try:
        return cast(RenderEngine, entry.load()())
    except (ImportError, AttributeError) as error:
        raise EngineUnavailableError(f"engine: {entry.name!r} cannot be loaded from {entry.value}: {error}") from error
