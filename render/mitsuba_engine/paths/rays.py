"""Rays of a frame in the stage's axes, through any place of a pixel at any time of the exposure.

`StratifiedSamples` are the places and moments of rays whose number differs from pixel to pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.frame import FrameSpec
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye
from render.camera.exposure_motion import pose_polynomial
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.sun_sky_integrator import SceneLights, SkyIrradiance
from render.mitsuba_engine.render_noise import DUPLICATE_EVERY, LEAST_COUNT, MOST_COUNT
from render.mitsuba_engine.scene import DrogueScene, as_mitsuba_reads, by_shape
from render.mitsuba_engine.trace_request import SamplingPlan
from scenes.environment_radiance import EnvironmentRadiance

# A number of this many bits is exact in a float; rows and columns of a lattice have so many each.
_UNIT_BITS, _LATTICE_BITS = 24, 11
MOST_LANES = 2_000_000
"""Most lanes of one kernel launch: bounds memory (about 300 bytes per lane) at no cost in speed."""


class CameraRays:
    """Rays of one eye in the stage's axes, through its lens if it has one."""

    def __init__(self, frame: FrameSpec, eye: Eye) -> None:
        self.camera: PinholeCamera = frame.rig.camera
        lens = frame.rig.lens(eye)
        self._slopes = None if lens is None else _corner_slopes(lens)
        self._pose = pose_polynomial(frame, eye)
        self.pose_at_middle = self._pose[0]
        self.moves = bool(np.abs(self._pose[1:]).max() > 0)
        # Of each pixel, where anything moves: 0 where what flies with the camera is seen, else 1.
        self._moving: Any = None
        self.hold(np.zeros((self.camera.height_px, self.camera.width_px), dtype=np.bool_))
        # Python numbers would become part of the compiled kernel, so that every frame would compile its own.
        self._opaque_pose = [
            [[dr.opaque(mi.Float, float(value)) for value in row] for row in coefficient] for coefficient in self._pose
        ]

    def stage_from_eye(self, s: float) -> RigidTransform:
        """Pose at mid-exposure (s = 0) or at one of its ends (-1, 1), where the polynomial is exact."""
        matrix = np.vstack([self._pose[0] + s * (self._pose[1] + s * self._pose[2]), [0.0, 0.0, 0.0, 1.0]])
        return RigidTransform.from_matrix(matrix)

    def hold(self, held: NDArray[np.bool_]) -> None:
        """See in (H, W) pixels only what is there at mid-exposure."""
        if self.moves:
            self._moving = jit_array(mi.Float, np.where(held, np.float32(0.0), np.float32(1.0)).ravel())

    def rays(self, pixel: Any, place: Any, moment: Any) -> Any:
        """Rays through pixels.

        Args:
            pixel: flat pixel indices.
            place: 2-D place in the pixel's box, (0.5, 0.5) its centre.
            moment: time in the exposure, 0 when the shutter opens and 1 when it closes.
        """
        camera = self.camera
        row = pixel // camera.width_px
        u = mi.Float(pixel - row * camera.width_px) + (place.x - 0.5)
        v = mi.Float(row) + (place.y - 0.5)
        if self._slopes is None:
            slope_x, slope_y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
        else:
            slope_x, slope_y = (self._between_corners(slopes, pixel + row, place) for slopes in self._slopes)
        local = dr.normalize(mi.Vector3f(slope_x, slope_y, mi.Float(1.0)))
        pose = self._pose_at(2.0 * moment - 1.0, pixel)
        direction = mi.Vector3f(*[pose[i][0] * local.x + pose[i][1] * local.y + pose[i][2] * local.z for i in range(3)])
        return mi.Ray3f(mi.Point3f(*[pose[i][3] for i in range(3)]), dr.normalize(direction))

    def _between_corners(self, slopes: Any, corner: Any, place: Any) -> Any:
        """Slopes at places of pixels, interpolated between their four corners; `corner` is the index of the first."""
        low, high = corner, corner + self.camera.width_px + 1
        first, second, third, fourth = (dr.gather(mi.Float, slopes, at) for at in (low, low + 1, high, high + 1))
        return dr.lerp(dr.lerp(first, second, place.x), dr.lerp(third, fourth, place.x), place.y)

    def _pose_at(self, s: Any, pixel: Any) -> list[list[Any]]:
        c = self._opaque_pose
        if not self.moves:
            return c[0]
        s = s * dr.gather(mi.Float, self._moving, pixel)
        return [[c[0][i][j] + s * (c[1][i][j] + s * c[2][i][j]) for j in range(4)] for i in range(3)]


def _corner_slopes(lens: Lens) -> tuple[Any, Any]:
    """Slopes x / z and y / z of the rays through the pixel corners of an eye with a lens, row by row.

    Within one pixel they deviate from linear interpolation by less than 1e-7.
    """
    camera = lens.camera
    u, v = np.meshgrid(np.arange(camera.width_px + 1) - 0.5, np.arange(camera.height_px + 1) - 0.5)
    rays = lens.rays(np.stack([u, v], axis=-1)).astype(np.float32)
    return jit_array(mi.Float, rays[..., 0].ravel()), jit_array(mi.Float, rays[..., 1].ravel())


@dataclass(frozen=True, eq=False)
class SampledLight:
    """Sampled light of pixels of both eyes; flat indices of the right eye come after all of the left's.

    Attributes:
        pixel: (P,) flat indices.
        light: (P, 4) radiance [cd/m2] and coverage.
        duplicate_pixel: (A,) pixels of the drogue that were traced a second time.
        duplicate_light: (A, 4) result of the second time.
        duplicate_error: (A, 3) known errors of radiance that both have in common. [cd/m2]
    """

    pixel: NDArray[np.int64]
    light: NDArray[np.float32]
    duplicate_pixel: NDArray[np.int64]
    duplicate_light: NDArray[np.float32]
    duplicate_error: NDArray[np.float32]

    def with_pixels(self, pixel: NDArray[np.int64], light: NDArray[np.float32]) -> SampledLight:
        """The same and other pixels, which were traced once."""
        return replace(self, pixel=np.concatenate([self.pixel, pixel]), light=np.concatenate([self.light, light]))


class FrameRays:
    """Cameras, lights and random numbers of one frame.

    Attributes:
        has_map: (256,) by part ids, whether a part's paint varies.
    """

    def __init__(
        self,
        frame: FrameSpec,
        scene: DrogueScene,
        cameras: Sequence[CameraRays],
        ambient: EnvironmentRadiance,
        open_to_sky: NDArray[np.uint8],
    ) -> None:
        """Set up the rays of a frame.

        Args:
            frame: cameras, exposure and seed.
            scene: set up for the frame.
            cameras: of both eyes.
            ambient: radiance of its environment.
            open_to_sky: (256,) 1 for parts whose light from the whole sky is taken as known; see `SceneLights`.
        """
        self.scene = scene.scene
        self.width_px = frame.rig.camera.width_px
        self.size = self.width_px * frame.rig.camera.height_px
        self.focal_px = frame.rig.camera.fx_px
        self._cameras = cameras
        self._seeds = frame_generator(frame.seed, frame.frame_index, "mitsuba samples")
        self.has_map = np.zeros(256, dtype=np.bool_)
        self.has_map[[surface.part_id for surface in scene.surfaces if surface.uv is not None]] = True
        to_sun, sun_lux = scene.sun
        world_from_stage = frame.world_from_left @ frame.left_from_stage_at(0.0)
        lights_others = scene.lights_others()
        self.lights = SceneLights(
            to_sun=to_sun,
            sun_lux=sun_lux,
            sky=SkyIrradiance(as_mitsuba_reads(ambient.light_map), world_from_stage.rotation),
            open_to_sky=jit_array(mi.Float, by_shape(scene.scene, open_to_sky)),
            parts_emit=scene.emits,
            lights_others=None if lights_others is None else jit_array(mi.Float, lights_others),
        )

    def stage_from_eye(self, eye: Eye) -> RigidTransform:
        """Pose of an eye at mid-exposure."""
        return self._cameras[EYES.index(eye)].stage_from_eye(0.0)

    def pixels_of_both_eyes(self, plans: dict[Eye, SamplingPlan], kind: str) -> NDArray[np.int64]:
        """Pixels of one group of both eyes' plans, such as `edges`."""
        return np.concatenate([getattr(plans[eye], kind) + index * self.size for index, eye in enumerate(EYES)])

    def launch_chunks(self, pixel: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
        """Pixels in chunks of at most `MOST_LANES` lanes, with `count` samples per pixel."""
        return np.split(pixel, range(max(MOST_LANES // count, 1), len(pixel), max(MOST_LANES // count, 1)))

    def sampler(self, lanes: int, count: int) -> Any:
        """A sampler with a seed of its own, for `count` neighbouring lanes per pixel."""
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        # The multijitter sampler rounds its count to a product of two near-equal factors.
        if sampler.sample_count() != count:
            sampler = mi.load_dict({"type": "independent", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(int(self._seeds.integers(2**31)), lanes)
        return sampler

    def random_bits(self, kinds: int, pixels: int) -> NDArray[np.uint32]:
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
    # Without this evaluation every sum would trace the paths again.
    dr.eval(channels)
    sums = np.stack([np.array(dr.block_sum(channel, count)) for channel in channels], axis=-1)
    means: NDArray[np.float32] = sums / np.float32(count)
    return means


def rows_of(vector: Any) -> NDArray[np.float32]:
    """(P, 3) array of an evaluated vector.

    Converting the vector as a whole would compile a kernel for every P.
    """
    axes: NDArray[np.float32] = np.stack([np.array(axis) for axis in vector])
    return axes.T


def with_duplicates(pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pixels, followed by one in `DUPLICATE_EVERY` of them a second time."""
    return np.concatenate([pixel, pixel[::DUPLICATE_EVERY]])


class StratifiedSamples:
    """Places and moments of samples whose number differs from pixel to pixel; one kernel serves all numbers.

    Places are the first two dimensions of the Sobol sequence and moments the third, with their bits flipped at random
    for each pixel. Any power of two of them is stratified in every division of a pixel into that many equal rectangles.

    Source: I. M. Sobol', USSR Computational Mathematics and Mathematical Physics 7 (1967), 86,
    doi:10.1016/0041-5553(67)90144-9.
    """

    def __init__(self, rays: FrameRays, pixel: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Take (P,) flat indices, and how many samples each pixel takes."""
        self.total = int(counts.sum())
        self._counts, self._first = counts, np.cumsum(counts) - counts
        row = jit_array(mi.UInt32, np.repeat(np.arange(len(pixel), dtype=np.uint32), counts))

        def of_row(values: NDArray[np.generic]) -> mi.UInt32:
            return dr.gather(mi.UInt32, jit_array(mi.UInt32, values), row)

        index = dr.arange(mi.UInt32, self.total) - of_row(self._first)
        flips = rays.random_bits(3, len(pixel))
        self.pixel = of_row(pixel)
        self.place = mi.Point2f(
            _unit_interval(dr.brev(index) ^ of_row(flips[0])),
            _unit_interval(_sobol(index, (1,)) ^ of_row(flips[1])),
        )
        self.moment = _unit_interval(_sobol(index, (1, 3)) ^ of_row(flips[2]))

    def means(self, channels: list[mi.Float]) -> NDArray[np.float32]:
        """(P, len(channels)) means over the samples of each pixel."""
        # Without this evaluation every sum would trace the rays again.
        dr.eval(channels)
        block = math.gcd(LEAST_COUNT, *np.unique(self._counts).tolist())
        blocks = [dr.block_sum(channel, block) if block > 1 else channel for channel in channels]
        sums = [np.add.reduceat(np.array(values), self._first // block) for values in blocks]
        means: NDArray[np.float32] = np.stack(sums, axis=-1) / self._counts[:, None].astype(np.float32)
        return means


def chunks_by_count(pixel: NDArray[np.int64], counts: NDArray[np.int64]) -> Iterator[tuple[NDArray, NDArray]]:  # type: ignore[type-arg]
    """Pixels and their counts of samples, in chunks of about `MOST_LANES` samples."""
    launch = np.cumsum(counts) // MOST_LANES
    for rows in np.split(np.arange(len(pixel)), np.flatnonzero(np.diff(launch)) + 1):
        if len(rows):
            yield pixel[rows], counts[rows]


def stratified_over_image(rays: FrameRays, place: tuple[NDArray[np.int64], NDArray[np.int64]], count: int) -> Any:
    """2-D numbers for `count` neighbouring lanes of each place of a lattice, stratified over neighbouring places too.

    The places take the points of one Sobol sequence in the order of a curve through the lattice, so that all blocks of
    2^k x 2^k places together are as evenly filled as one place of as many samples. What is smoothed over the lattice
    then has much less noise.

    Source: A. G. M. Ahmed and P. Wonka, Screen-space blue-noise diffusion of Monte Carlo sampling error via
    hierarchical ordering of pixels, ACM Transactions on Graphics 39 (2020), 244, doi:10.1145/3414685.3417881.

    Args:
        rays: of the frame.
        place: (P,) rows and columns.
        count: a power of two.
    """
    order = sum((place[axis] >> bit & 1) << (2 * bit + 1 - axis) for axis in range(2) for bit in range(_LATTICE_BITS))
    lane = dr.arange(mi.UInt32, len(place[0]) * count)
    of_place = lane // dr.opaque(mi.UInt32, count)
    index = dr.gather(mi.UInt32, jit_array(mi.UInt32, order * count), of_place) + lane - of_place * mi.UInt32(count)
    flips = [dr.opaque(mi.UInt32, int(bits[0])) for bits in rays.random_bits(2, 1)]
    return mi.Point2f(
        _unit_interval(dr.brev(index) ^ flips[0]), _unit_interval(_sobol(index, (1,), _UNIT_BITS) ^ flips[1])
    )


def _sobol(index: mi.UInt32, initial: tuple[int, ...], bits_of_index: int = MOST_COUNT.bit_length() - 1) -> mi.UInt32:
    """One dimension of the Sobol sequence as 32-bit binary fractions.

    Args:
        index: positions in the sequence.
        initial: first numbers of its recurrence, as many as the degree of its polynomial, whose coefficients are 1.
        bits_of_index: further bits of the positions are 0.
    """
    numbers = list(initial)
    bits = mi.UInt32(0)
    for place in range(bits_of_index):
        if place >= len(initial):
            degree = len(initial)
            number = numbers[-degree] << degree ^ numbers[-degree]
            for back in range(1, degree):
                number ^= numbers[-back] << back
            numbers.append(number)
        direction = numbers[place] << 31 - place
        bits ^= dr.select((index & (1 << place)) != 0, mi.UInt32(direction), 0)
    return bits


def _unit_interval(bits: mi.UInt32) -> mi.Float:
    """A 32-bit binary fraction as a number in [0, 1)."""
    return mi.Float(bits >> 32 - _UNIT_BITS) * mi.Float(2.0**-_UNIT_BITS)
