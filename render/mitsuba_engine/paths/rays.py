"""Rays of one frame through pixels of both eyes, and paths along them: what every way of tracing shares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.frame import FrameSpec
from geometry.stereo import EYES, Eye
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.camera_rays import CameraRays
from render.mitsuba_engine.paths.sun_sky_integrator import Lights
from render.mitsuba_engine.render_noise import TWICE_EVERY
from render.mitsuba_engine.scene import DrogueScene, by_shape
from render.mitsuba_engine.sky_irradiance import SkyIrradiance, as_mitsuba_reads
from render.mitsuba_engine.trace_request import Plan
from scenes.environment_radiance import Surroundings

MOST_LANES = 2_000_000
"""Lanes of one launch: bounds memory (about 300 bytes a lane) without costing speed."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """What samples say of the pixels of both eyes; those of the right eye come after all of the left.

    Attributes:
        pixel: (P,) flat indices.
        light: (P, 4) radiance [cd/m2] and coverage.
        again: (A,) pixels of the drogue that were traced a second time.
        light_again: (A, 4) what came of it.
        error_again: (A, 3) known errors of their radiance that both share. [cd/m2]
    """

    pixel: NDArray[np.int64]
    light: NDArray[np.float32]
    again: NDArray[np.int64]
    light_again: NDArray[np.float32]
    error_again: NDArray[np.float32]

    def beside(self, pixel: NDArray[np.int64], light: NDArray[np.float32]) -> Sampled:
        """The same with other pixels that were traced once."""
        return replace(self, pixel=np.concatenate([self.pixel, pixel]), light=np.concatenate([self.light, light]))


class FrameRays:
    """Cameras, lights and random numbers of one frame."""

    def __init__(self, frame: FrameSpec, scene: DrogueScene, around: Surroundings, in_open: NDArray[np.uint8]) -> None:
        """With a table by part id of what takes the open sky's light as known; see `Lights`."""
        self.scene = scene.scene
        self.width_px = frame.rig.camera.width_px
        self.size = self.width_px * frame.rig.camera.height_px
        self.focal_px = frame.rig.camera.fx_px
        self._cameras = [CameraRays(frame, eye) for eye in EYES]
        self._seeds = frame_generator(frame.seed, frame.frame_index, "mitsuba samples")
        to_sun, sun_lux = scene.sun
        world_from_stage = frame.world_from_left @ frame.left_from_stage_at(0.0)
        self.lights = Lights(
            to_sun,
            sun_lux,
            SkyIrradiance(as_mitsuba_reads(around.light_map), world_from_stage.rotation),
            jit_array(mi.Float, by_shape(scene.scene, in_open)),
            frame.drogue is not None and frame.drogue.marker_luminance_cd_m2 > 0,
        )

    def of_both(self, plans: dict[Eye, Plan], kind: str) -> NDArray[np.int64]:
        """Pixels of a kind of both eyes' plans."""
        return np.concatenate([getattr(plans[eye], kind) + index * self.size for index, eye in enumerate(EYES)])

    def parts(self, pixel: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
        """The same pixels in as many pieces as launches of so many samples a pixel need."""
        return np.split(pixel, range(max(MOST_LANES // count, 1), len(pixel), max(MOST_LANES // count, 1)))

    def sampler(self, lanes: int, count: int) -> Any:
        """A sampler with a seed of its own, for `count` neighbouring lanes a pixel."""
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        # The multijitter sampler rounds its count to a product of two near-equal factors.
        if sampler.sample_count() != count:
            sampler = mi.load_dict({"type": "independent", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(int(self._seeds.integers(2**31)), lanes)
        return sampler

    def bits(self, kinds: int, pixels: int) -> NDArray[np.uint32]:
        """(kinds, pixels) random bits."""
        return self._seeds.integers(2**32, size=(kinds, pixels), dtype=np.uint32)

    def through(self, pixel: Any, place: Any, moment: Any) -> Any:
        """Rays of either eye, whichever the pixels belong to; arguments as in `CameraRays.rays`."""
        is_right = pixel >= self.size
        left, right = (
            camera.rays(dr.select(is_right, pixel - self.size, pixel), place, moment) for camera in self._cameras
        )
        return mi.Ray3f(dr.select(is_right, right.o, left.o), dr.select(is_right, right.d, left.d))


def means_by_pixel(channels: list[Any], count: int) -> NDArray[np.float32]:
    """(P, len(channels)) means over `count` neighbouring lanes."""
    # Without this every sum would trace the paths again.
    dr.eval(channels)
    sums = np.stack([np.array(dr.block_sum(channel, count)) for channel in channels], axis=-1)
    means: NDArray[np.float32] = sums / np.float32(count)
    return means


def rows_of(vector: Any) -> NDArray[np.float32]:
    """(P, 3) numbers of an evaluated vector.

    Converted as a whole, it would go through a kernel of its own for every P.
    """
    axes: NDArray[np.float32] = np.stack([np.array(axis) for axis in vector])
    return axes.T


def and_some_again(pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pixels, then every so many of them a second time."""
    return np.concatenate([pixel, pixel[::TWICE_EVERY]])
