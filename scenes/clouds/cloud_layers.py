"""Cloud layers: rays are marched through each layer's density and shaded where they hit cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import CloudLayer
from scenes.clouds.cloud_density import CELLS, HEAP, SHEET, layer_excess
from scenes.clouds.cloud_textures import BLOBS_PER_TILE, body_tile, lump_volume
from scenes.clouds.ray_march import EARTH_M, MOST_DEPTH, enlarge, march_rays, starts_of
from scenes.clouds.thin_layers import ice_sample_depths, shaft_depth, thin_depth
from scenes.ground_view import pixel_angle_rad
from scenes.sky.photometry import Radiance, henyey_greenstein

_Field = NDArray[np.float32]
ThroughAir = Callable[[Radiance, _Field, NDArray[np.int64]], Radiance]

# Droplets scatter forward; ice crystals less so.
_DROPLET_ASYMMETRY, _ICE_ASYMMETRY = 0.8, 0.72
# Two streams: a layer of optical depth t lets 1 / (1 + b t) through, b = 0.75 (1 - g) with g = 0.85 for droplets
# (Coakley and Chylek 1975, doi:10.1175/1520-0469(1975)032<0409:TTSAIR>2.0.CO;2).
BACK_SCATTER = 0.11
_LOWEST_THIN_RISE = 0.08
THIN_KINDS = ("cirrus", "contrail", "rain")
_FADING_RISE, _FADING_RISE_AT_GROUND = 0.005, 1e-4
_COVER_SAMPLES, _MOST_THRESHOLD, _THRESHOLD_BISECTIONS = 96, 12.0, 14
# Height over thickness at which the bodies of a shape are widest.
_WIDEST_AT = {HEAP: 0.28, SHEET: 0.45, CELLS: 0.5}
# With this as the smallest detail only the larger shape is left. [m]
_LARGER_SHAPE_M = 1e6
# Width of a shadow's edge in units of the larger shape.
_SHADOW_EDGE = 0.22
# Light that droplets turned once, a few times and often: each time less is left of the forward peak, and what is left
# reaches deeper. Share, asymmetry, extinction over that of the beam (Wrenninge 2013, doi:10.1145/2504435.2504451).
_FORWARD = ((0.22, 0.8, 1.0), (0.3, 0.6, 0.3), (0.2, 0.35, 0.08))
_CREASE, _THIN, _LEAVES, _RIM, _VEIL = 0.8, 0.75, 0.55, 0.45, 0.2
# Step between the first rays of a large picture, and how much of the way to the nearest cloud around is free of it.
_FIRST_STEP_PX, _BEFORE_CLOUD, _ROW = 8, 0.96, 256
# Steps between further rays, of which those are marched whose neighbours, twice as far apart, differ more than this.
# Rays through layers without depth cost so little that fine fibres get theirs.
_REFINEMENTS, _REFINEMENTS_THIN = ((2, 0.08), (1, 0.35)), ((1, 0.05),)

# A pixel that looks along so much of a swell begins to sparkle, and along so much of it does nothing else; so many
# neighbours, an odd number, are averaged.
_SPARKLES_FROM, _SPARKLES, _SPARKLE_PX = 0.04, 0.25, 31
# Rays that rise so much more than those that miss a layer look along nearly as much of it as any. [sine]
_FLAT_RISE = 1e-5


@dataclass(frozen=True)
class CloudLight:
    """Light on a layer.

    Attributes:
        direction: (3,) towards sun or moon.
        beam_lux: (3,) illuminance of a plane that faces the beam, at the layer. [lux]
        sky_lux: (3,) illuminance of the layer from above without the beam. [lux]
        ground_lux: (3,) illuminance of the layer from below. [lux]
    """

    direction: NDArray[np.float64]
    beam_lux: NDArray[np.float64]
    sky_lux: NDArray[np.float64]
    ground_lux: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CloudLayerView:
    """One layer along every ray.

    Attributes:
        radiance: (H, W, 3) of the cloud itself, without air in front of it. [cd/m2]
        opacity: (H, W) share of the light behind it that the cloud hides.
        distance_m: (H, W) distance of the visible cloud. [m]
    """

    radiance: Radiance
    opacity: _Field
    distance_m: _Field


def diffuse_transmission(layer: CloudLayer) -> float:
    """Mean share of light that the layer transmits, direct or scattered."""
    if layer.kind == "cirrus":
        return float(np.mean(1.0 / (1.0 + BACK_SCATTER * ice_sample_depths(layer)), dtype=np.float64))
    return 1.0 - layer.shading_fraction * (1.0 - 1.0 / (1.0 + BACK_SCATTER * layer.optical_depth))


def direct_transmission(layer: CloudLayer) -> float:
    """Mean share of light that the layer transmits directly."""
    if layer.kind == "cirrus":
        return float(np.mean(np.exp(-ice_sample_depths(layer)), dtype=np.float64))
    return 1.0 - layer.shading_fraction * (1.0 - float(np.exp(-layer.optical_depth)))


class LayerGeometry:
    """Where rays meet a layer over the round Earth.

    Args:
        layer: its description.
        horizon_sine: of the elevation of the ground's horizon, where the Earth is round under the camera too; None
            for layers that rise towards level rays, above and below.

    Attributes:
        least_rise: sine of the elevation towards the layer beyond which rays miss it.
        fading_rise: how far above `least_rise` it reaches its full opacity.
        base_m: height of its base over the camera. [m]
        bend_per_m: a ray gains this times the square of its length in height over the layer's level. [1/m]
    """

    def __init__(self, layer: CloudLayer, horizon_sine: float | None = None) -> None:
        self._near_m, self._thick_m = abs(layer.height_above_camera_m), layer.thickness_m
        self.sign = 1.0 if layer.is_above else -1.0
        sinks = horizon_sine is not None and not layer.is_above
        self._curve = -2.0 if sinks else 2.0
        self.bend_per_m = (1.0 if sinks else self.sign) / (2.0 * EARTH_M)
        self.base_m = layer.height_above_camera_m - (0.0 if layer.is_above else layer.thickness_m)
        self.least_rise, self.fading_rise = 0.0, _FADING_RISE
        if horizon_sine is not None:
            below = float(np.sqrt(2.0 * self._near_m / EARTH_M))
            self.least_rise = horizon_sine if layer.is_above else below
            # The ground's horizon cuts off what lies above it.
            self.fading_rise = _FADING_RISE_AT_GROUND if layer.is_above else _FADING_RISE

    def crossing(self, rise: _Field) -> tuple[_Field, _Field]:
        """Distances at which rays that rise towards the layer enter and leave it. [m]"""
        steep = np.maximum(rise, np.float32(self.least_rise))
        # The roots of h = s rise +- s^2 / 2 R, in a form without cancellation for steep rays.
        entry, leave = (
            np.float32(2.0 * h)
            / (steep + np.sqrt(np.maximum(steep * steep + np.float32(self._curve * h / EARTH_M), np.float32(0.0))))
            for h in (self._near_m, self._near_m + self._thick_m)
        )
        return entry, leave

    def pixel_length_m(self, rise: _Field, pixel_rad: float) -> _Field:
        """How much of the layer's plan lies behind a pixel along rays that rise towards the layer, 0 for others. [m]"""
        entry_m, _ = self.crossing(rise)
        sine = rise + np.float32(2.0 * self.sign * self.bend_per_m) * entry_m
        length_m: _Field = np.where(
            rise > self.least_rise, entry_m * np.float32(pixel_rad) / np.maximum(sine, np.float32(1e-5)), 0.0
        )
        return length_m

    def fading(self, rise: _Field) -> _Field:
        """Share of the layer's opacity that is left towards the horizon."""
        share: _Field = np.clip((rise - np.float32(self.least_rise)) / np.float32(self.fading_rise), 0.0, 1.0)
        return share


class CloudShape:
    """The density of a layer with depth, as the compiled loops take it.

    Attributes:
        numbers: the parameters of `excess_at`: kind, size of the largest bodies [m], thickness [m], threshold that the
            cover sets, metres per unit of the larger shape, size of swells [m] and their amount, size of the largest
            lumps [m], their amount [m] and its ratio from octave to octave, a shift of the lumps, depth over which the
            edge gets dense [m], and two terms by which bodies narrow upwards.
        body, lumps: textures.
        extinction_per_m: inside the cloud. [1/m]
    """

    def __init__(self, layer: CloudLayer) -> None:
        size_m, thick_m = layer.feature_size_m, layer.thickness_m
        shift = (layer.texture_seed % 4096) * 0.61803
        self.extinction_per_m = 2.6 * layer.optical_depth / thick_m
        slope = 2.6
        falls = (2.0, 1.2)
        metric_m = 1.0 / (2.4 / thick_m + 4.0 / size_m)
        if layer.kind == "stratus":
            kind, swell_m, swell, fine_m, fine, soft_m = SHEET, 0.30 * size_m, 0.30, 0.16 * size_m, 0.45, 0.06
            fine_m = min(fine_m, 0.9 * thick_m)
            metric_m = 0.12 * size_m
        elif layer.kind == "altocumulus":
            kind, swell_m, swell, fine_m, fine, soft_m = CELLS, size_m, 1.3, 0.30 * size_m, 0.30, 0.45
            metric_m = 0.22 * size_m
        else:
            kind, swell_m, swell, fine_m, fine, soft_m = HEAP, 0.36 * size_m, 2.4, 0.13 * size_m, 0.8, 0.08
            if layer.kind == "congestus":
                falls, swell, swell_m = (1.1, 2.6), 2.0, 0.28 * size_m
                metric_m = 1.0 / (1.8 / thick_m + 4.0 / size_m)
        numbers = [kind, size_m, thick_m, 0.0, metric_m, swell_m, swell, fine_m, fine * fine_m, 0.6, shift]
        self.numbers = np.array([*numbers, max(soft_m * fine_m, 1.5), *falls])
        self.body, self.lumps = body_tile(layer.texture_seed, slope), lump_volume()
        self.numbers[3] = self._threshold(layer.cover_fraction)

    def _threshold(self, cover_fraction: float) -> float:
        """What must be taken off the larger shape so that cloud covers its share of the plan."""
        size_m, thick_m = self.numbers[1], self.numbers[2]
        side_m = (np.arange(_COVER_SAMPLES) + 0.5) * (BLOBS_PER_TILE * size_m / _COVER_SAMPLES)
        east_m, north_m = np.meshgrid(side_m, side_m)
        height_m = np.full(east_m.size, _WIDEST_AT[int(self.numbers[0])] * thick_m)
        places_m = np.stack([east_m.ravel(), north_m.ravel(), height_m], axis=-1)
        low, high, numbers = -_MOST_THRESHOLD, _MOST_THRESHOLD, self.numbers.copy()
        for _ in range(_THRESHOLD_BISECTIONS):
            numbers[3] = 0.5 * (low + high)
            covered = layer_excess(numbers, self.body, self.lumps, places_m, _LARGER_SHAPE_M) > 0.3 * numbers[11]
            low, high = (numbers[3], high) if covered.mean() > cover_fraction else (low, numbers[3])
        return float(high if cover_fraction < 1.0 else low)


@lru_cache(maxsize=16)
def cloud_shape(layer: CloudLayer) -> CloudShape:
    """The shape of a layer with depth."""
    return CloudShape(layer)


def cloud_share(layer: CloudLayer, east_m: _Field, north_m: _Field) -> _Field:
    """(H, W) share of the vertical through places in a layer's plan that is cloud, with soft edges.

    Args:
        layer: of none of `THIN_KINDS`.
        east_m, north_m: (H, W) places, from the layer's origin. [m]
    """
    shape = cloud_shape(layer)
    numbers = shape.numbers
    height_m = np.full(east_m.size, _WIDEST_AT[int(numbers[0])] * numbers[2])
    places_m = np.stack([east_m.ravel(), north_m.ravel(), height_m], axis=-1).astype(np.float64)
    excess_m = layer_excess(numbers, shape.body, shape.lumps, places_m, _LARGER_SHAPE_M) - 0.3 * numbers[11]
    share: _Field = np.clip(excess_m / (_SHADOW_EDGE * numbers[4]) + 0.5, 0.0, 1.0).astype(np.float32)
    return share.reshape(east_m.shape)


@dataclass(frozen=True, eq=False)
class _Found:
    """What rays met.

    Attributes:
        view: the layer along them.
        entry_m: (H, W) distance at which they enter cloud, 1e9 for none. [m]
    """

    view: CloudLayerView
    entry_m: _Field


class CloudLayerRenderer:
    """One layer in its light, as seen from one place.

    Args:
        layer: its description.
        light: on the layer.
        offset_m: of the camera, east and north of the layer's origin. [m]
        horizon_sine: as in `LayerGeometry`.
    """

    def __init__(
        self,
        layer: CloudLayer,
        light: CloudLight,
        offset_m: tuple[float, float] = (0.0, 0.0),
        horizon_sine: float | None = None,
    ) -> None:
        self._layer, self._light, self._offset_m = layer, light, offset_m
        self._where = LayerGeometry(layer, horizon_sine)

    def view(self, directions: NDArray[np.float32], pixel_rad: float) -> CloudLayerView:
        """The layer along (H, W, 3) unit directions in any order; detail smaller than `pixel_rad` is left out."""
        return self._march(directions, pixel_rad).view

    def picture(
        self, directions: NDArray[np.float32], through_air: ThroughAir, behind: Radiance | None = None
    ) -> Radiance:
        """The layer in a large picture, behind air.

        Rays are marched every fourth down and across, then every second and at last every single one where neighbours
        differ in what is seen, from where neighbours met cloud; the rest is interpolated. Layers without depth begin
        with every second ray.

        Args:
            directions: (H, W, 3) unit vectors; neighbours in the array are neighbours in direction.
            through_air: takes light (h, w, 3), distance (h, w) [m] and flat indices (h, w) of rays, and gives the light
                that is left of it and that of the air.
            behind: (H, W, 3) light that comes from behind the layer [cd/m2]; None if it is not known.

        Returns:
            (H, W, 4) light times opacity, and opacity.
        """
        height, width = directions.shape[:2]
        pixel_rad, rays = pixel_angle_rad(directions), directions.reshape(-1, 3)
        indices = np.arange(height * width).reshape(height, width)
        thin = self._layer.kind in THIN_KINDS
        entry_m, every = None, _FIRST_STEP_PX
        if not thin:
            entry_m = self._march(
                rays[np.ascontiguousarray(indices[::every, ::every])], 0.5 * every * pixel_rad
            ).entry_m
        refinements = _REFINEMENTS_THIN if thin else _REFINEMENTS
        coarse = np.ascontiguousarray(indices[:: 2 * refinements[0][0], :: 2 * refinements[0][0]])
        found = self._march(rays[coarse], pixel_rad, self._starts(entry_m, every, coarse, width))
        picture = self._layered(found.view, coarse, through_air)
        if not thin:
            entry_m, every = found.entry_m, 2 * refinements[0][0]
        for step_px, contrast in refinements:
            finer = np.ascontiguousarray(indices[::step_px, ::step_px])
            large = np.empty((*finer.shape, 4), dtype=np.float32)
            edge = np.empty(finer.shape, dtype=np.bool_)
            seen = picture[..., :3]
            if behind is not None:
                seen = seen + (1.0 - picture[..., 3:]) * behind[:: 2 * step_px, :: 2 * step_px]
            enlarge(picture, np.ascontiguousarray(seen), behind is None, 2, contrast, large, edge)
            if len(places := np.flatnonzero(edge)):
                # Rows of rays, as pictures have.
                places = np.resize(places, (-(-len(places) // _ROW), _ROW))
                at = finer.ravel()[places]
                near = self._march(rays[at], pixel_rad, self._starts(entry_m, every, at, width))
                large.reshape(-1, 4)[places] = self._layered(near.view, at, through_air)
            picture = large
        return picture if thin else self._smoothed_afar(picture, directions, pixel_rad)

    def _smoothed_afar(self, picture: Radiance, directions: NDArray[np.float32], pixel_rad: float) -> Radiance:
        """The picture, averaged along the horizon where a pixel looks along much of a swell or more.

        There each ray meets the layer at random, and the picture would sparkle. Neighbours beside each other meet what
        other rays of the pixel would.
        """
        where, swell_m = self._where, cloud_shape(self._layer).numbers[5]
        rise = directions[..., 2] * np.float32(where.sign)
        # The flattest ray of a row looks along most.
        flattest = np.maximum(rise.min(axis=1), np.float32(where.least_rise + _FLAT_RISE))
        looks_along = where.pixel_length_m(flattest, pixel_rad) > _SPARKLES_FROM * swell_m
        rows = np.flatnonzero(looks_along & (rise.max(axis=1) > where.least_rise))
        if not len(rows):
            return picture
        part = slice(rows[0], rows[-1] + 1)
        rise = rise[part]
        swells = where.pixel_length_m(rise, pixel_rad) / np.float32(swell_m)
        share = np.clip((swells - _SPARKLES_FROM) / (_SPARKLES - _SPARKLES_FROM), 0.0, 1.0).astype(np.float32)
        down, across = abs(rise[-1] - rise[0]).mean() / len(rise), abs(rise[:, -1] - rise[:, 0]).mean() / rise.shape[1]
        size = (_SPARKLE_PX, 1) if across < down else (1, _SPARKLE_PX)
        picture[part] += share[..., None] * (cv2.GaussianBlur(picture[part], size, 0) - picture[part])
        return picture

    def _starts(self, entry_m: _Field | None, every: int, indices: NDArray[np.int64], width: int) -> _Field | None:
        if entry_m is None:
            return None
        return starts_of(entry_m, every, indices.ravel(), width).reshape(indices.shape) * np.float32(_BEFORE_CLOUD)

    def _layered(self, view: CloudLayerView, indices: NDArray[np.int64], through_air: ThroughAir) -> Radiance:
        light = through_air(view.radiance, view.distance_m, indices) * view.opacity[..., None]
        layered: Radiance = np.concatenate([light, view.opacity[..., None]], axis=-1)
        return layered

    def _march(self, directions: NDArray[np.float32], pixel_rad: float, starts_m: _Field | None = None) -> _Found:
        """What (H, W, 3) rays meet that meet nothing before (H, W) `starts_m`."""
        where, layer = self._where, self._layer
        rise = directions[..., 2] * np.float32(where.sign)
        near_m, far_m = where.crossing(rise)
        if layer.kind in THIN_KINDS:
            view = _render_ice(layer, directions, self._light, (near_m, rise, where), (pixel_rad, self._offset_m))
            return _Found(view, near_m)
        if starts_m is not None:
            near_m = np.clip(starts_m, near_m, far_m)
        far_m = np.where(rise > where.least_rise, far_m, near_m)
        shape = cloud_shape(layer)
        found = np.zeros((rise.size, 6), dtype=np.float32)
        ends_m = np.stack([near_m.ravel(), far_m.ravel()], axis=-1)
        place = np.array([*self._offset_m, where.base_m, where.bend_per_m, pixel_rad, shape.extinction_per_m])
        rays = np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32)
        march_rays(shape.numbers, shape.body, shape.lumps, rays, ends_m, place, self._light.direction, found)
        found = found.reshape(*rise.shape, 6)
        opaque = np.float32(1.0 / (1.0 - np.exp(-MOST_DEPTH)))
        opacity = np.minimum((1.0 - np.exp(-found[..., 0])) * opaque, 1.0) * where.fading(rise)
        radiance = _shade(layer, directions, found, self._light, float(shape.numbers[8]))
        return _Found(CloudLayerView(radiance, opacity, found[..., 1]), found[..., 5])


def render_cloud_layer(
    layer: CloudLayer,
    directions: NDArray[np.float32],
    light: CloudLight,
    offset_m: tuple[float, float] = (0.0, 0.0),
    horizon_sine: float | None = None,
) -> CloudLayerView:
    """The layer along (H, W, 3) unit directions in world axes, whose neighbours are neighbours in direction.

    Arguments as in `CloudLayerRenderer`.
    """
    return CloudLayerRenderer(layer, light, offset_m, horizon_sine).view(directions, pixel_angle_rad(directions))


def opacity_towards(
    layer: CloudLayer,
    direction: NDArray[np.float64],
    offset_m: tuple[float, float] = (0.0, 0.0),
    horizon_sine: float | None = None,
) -> float:
    """Share of the sun's or moon's beam that the layer stops on the way to the camera; see `render_cloud_layer`."""
    if direction[2] * layer.height_above_camera_m <= 0 and (horizon_sine is None or not layer.is_above):
        return 0.0
    nothing = np.zeros(3)
    light = CloudLight(direction, nothing, nothing, nothing)
    ray = direction[None, None].astype(np.float32)
    return float(render_cloud_layer(layer, ray, light, offset_m, horizon_sine).opacity[0, 0])


def _shade(
    layer: CloudLayer, directions: NDArray[np.float32], found: _Field, light: CloudLight, lump_m: float
) -> Radiance:
    """Radiance of the visible cloud.

    Singly scattered sunlight keeps the droplets' forward peak (the silver lining) and falls off with the depth towards
    the sun; multiply scattered light reaches deeper and is even.

    Args:
        layer: its description.
        directions: (H, W, 3) rays.
        found: (H, W, 6) as `march_rays` fills it in.
        light: on the layer.
        lump_m: amount of the largest lumps. [m]
    """
    towards_sun, relief = found[..., 2], np.clip(found[..., 4] / np.float32(lump_m), -1.0, 1.0)
    height = np.clip(found[..., 3], 0.0, 1.0)
    cosine = np.einsum("...i,i->...", directions, light.direction.astype(np.float32))
    forward = sum(
        share * henyey_greenstein(cosine, asymmetry).astype(np.float32) * np.exp(np.float32(-reach) * towards_sun)
        for share, asymmetry, reach in _FORWARD
    )
    multiple = (0.5 * np.exp(-0.2 * towards_sun) + 0.42 / (1.0 + BACK_SCATTER * towards_sun)) / np.float32(np.pi)
    # Where there is little cloud, little is scattered more than once.
    multiple *= 1.0 - np.float32(_THIN) * np.exp(-found[..., 0])
    # Light that is turned often leaves a cloud near the surface that it came in by; seen from behind, that is dark.
    against = np.clip(0.3 + 1.4 * cosine, 0.0, 1.0)
    multiple *= 1.0 - np.float32(_LEAVES) * against * np.exp(-towards_sun)
    if layer.kind in ("cumulus", "congestus"):
        # The rim of a base sees the dark side of its own cloud.
        multiple *= np.float32(_RIM) + np.float32(1.0 - _RIM) * np.minimum(2.5 * height, 1.0)
        # Water grows with the height over the base: below its rim there is only a thin veil.
        forward *= np.float32(_VEIL) + np.float32(1.0 - _VEIL) * np.minimum(4.0 * height, 1.0)
    overhead = np.float32(layer.optical_depth) * (1.0 - height)
    from_above = (0.85 / np.pi) / (1.0 + np.float32(BACK_SCATTER) * overhead) * (0.6 + 0.4 * height)
    from_below = (0.75 / np.pi) * (1.0 - 0.75 * height)
    # Less of the sky is seen from between lumps.
    open_share = np.clip(1.0 + np.float32(_CREASE) * relief, 0.25, 1.3)
    out = ((forward + multiple) * (0.5 + 0.5 * open_share))[..., None] * light.beam_lux.astype(np.float32)
    out += (from_above * open_share)[..., None] * light.sky_lux.astype(np.float32)
    out += (from_below * open_share)[..., None] * light.ground_lux.astype(np.float32)
    result: Radiance = out.astype(np.float32)
    return result


def _render_ice(
    layer: CloudLayer,
    directions: NDArray[np.float32],
    light: CloudLight,
    where: tuple[_Field, _Field, LayerGeometry],
    seen_from: tuple[float, tuple[float, float]],
) -> CloudLayerView:
    """Ice cloud without depth: thin enough for single scattering plus an even share."""
    near_m, rise, geometry = where
    if layer.kind == "rain":
        return _render_rain(layer, directions, light, where, seen_from[1])
    depth = thin_depth(layer, directions, near_m, *seen_from)
    opacity = 1.0 - np.exp(-depth / np.maximum(rise, np.float32(_LOWEST_THIN_RISE)))
    opacity[rise <= geometry.least_rise] = 0.0
    cosine = np.einsum("...i,i->...", directions, light.direction.astype(np.float32))
    single = 0.7 * henyey_greenstein(cosine, _ICE_ASYMMETRY) + 0.3 / (4.0 * np.pi) + 0.1 / np.pi
    even = (light.sky_lux + light.ground_lux) / (2.0 * np.pi)
    radiance = single[..., None].astype(np.float32) * light.beam_lux.astype(np.float32) + even.astype(np.float32)
    return CloudLayerView(radiance=radiance.astype(np.float32), opacity=opacity, distance_m=near_m)


def _render_rain(
    layer: CloudLayer,
    directions: NDArray[np.float32],
    light: CloudLight,
    where: tuple[_Field, _Field, LayerGeometry],
    offset_m: tuple[float, float],
) -> CloudLayerView:
    """Shafts of rain: drops scatter nearly all light forward, so that they are as bright as what shines on them."""
    near_m, rise, geometry = where
    far_m = np.where(rise > geometry.least_rise, geometry.crossing(rise)[1], near_m)
    depth, middle_m = shaft_depth(layer, directions, (near_m, far_m), offset_m)
    cosine = np.einsum("...i,i->...", directions, light.direction.astype(np.float32))
    single = 0.3 * henyey_greenstein(cosine, _DROPLET_ASYMMETRY) + 0.05 / np.pi
    even = (light.sky_lux + light.ground_lux) / (4.5 * np.pi)
    radiance = single[..., None].astype(np.float32) * light.beam_lux.astype(np.float32) + even.astype(np.float32)
    opacity = (1.0 - np.exp(-depth)) * geometry.fading(rise)
    return CloudLayerView(radiance.astype(np.float32), opacity, middle_m)
