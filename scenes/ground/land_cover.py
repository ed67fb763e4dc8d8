"""What grows and stands on land: textures of fields, woods and towns, and roads and rivers between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import Environment, GroundKind
from scenes.ground.land_painting import TEXELS_M, LandKind
from scenes.ground.land_tiles import (
    BEAM_SCALE,
    HEIGHT_SCALE_M,
    LAMP_PEAK_CD_M2,
    SUN_TANGENTS,
    lamp_texture,
    land_textures,
)
from scenes.ground.sea import fresnel, inside_share
from scenes.ground.terrain import Seen
from scenes.ground_view import Axes, Field, GroundView, MipTile, kept_tile, power_noise, smooth_noise

_SEED = 3
_SIZE_PX, _TEXEL_M = 1024, 60.0
_REGION_CYCLES = (6.0, 8.0, 14.0)
_WARP_M = 110.0
_BRIGHTNESS, _TONE = 0.15, 0.05
_LAND_OF: dict[GroundKind, LandKind] = {
    "sea": "fields",
    "coast": "fields",
    "forest": "forest",
    "fields": "fields",
    "dry": "dry",
    "town": "town",
    "mountains": "forest",
    "snow": "fields",
    "airfield": "fields",
}
_WOOD = np.array([0.030, 0.042, 0.020], dtype=np.float32)
_ROAD = np.array([0.110, 0.106, 0.100], dtype=np.float32)
_ROCK = np.array([0.150, 0.140, 0.128], dtype=np.float32)
_MEADOW = np.array([0.080, 0.088, 0.042], dtype=np.float32)
_SNOW = np.array([0.78, 0.80, 0.83], dtype=np.float32)
_WATER = np.array([0.014, 0.024, 0.022], dtype=np.float32)
_BED = np.array([0.30, 0.25, 0.19], dtype=np.float32)  # of a dry river
# Height and spacing of hedges and rows of trees, which hide the ground behind them from low rays.
_HEDGE_M, _HEDGE_SPACING_M = 6.0, 220.0
_TOWN_ABOVE, _TOWN_EDGE = -0.45, 0.12
# Texels of one tile of detail at several sizes, and its strength there; seen from low altitude.
_DETAIL: tuple[tuple[float, float], ...] = ((2.3, 0.06), (0.55, 0.075), (0.127, 0.075), (0.031, 0.08))
_DETAIL_SPAN = 3.0
# Of the shares of trees and houses between texels, for edges nearby.
_EDGE_STEEPNESS = 7.0
_CROWN_TEXEL_M, _PATCH_TEXEL_M, _FOLIAGE_TEXEL_M, _HOUSES_TEXEL_M = 0.6, 6.0, 0.25, 1.2
_FOLIAGE, _FOLIAGE_CONTRAST = np.array([0.034, 0.045, 0.020], dtype=np.float32), 0.3
_WALL, _WALL_TONE = (np.array(rgb, dtype=np.float32) for rgb in ((0.27, 0.25, 0.22), (0.20, 0.25, 0.32)))
_STOREY_M, _WINDOW_SPACING_M, _GLASS = 3.0, 3.2, np.float32(0.7)


@dataclass(frozen=True, eq=False)
class Regions:
    """Slowly varying fields of the land, (H, W, ...).

    Attributes:
        signs: (H, W, 4) three fields whose signs separate regions, and brightness.
        per_m: (H, W, 3) length of the gradient of the first three. [1/m]
        moved: (H, W, 2) displacement of textures, of unit variance.
        above_m: height of the land. [m]
        slopes: (H, W, 2) of the land, east and north.
        sunny: share of the beam that clouds leave, over its mean.
    """

    signs: Field
    per_m: Field
    moved: Field
    above_m: Field
    slopes: Field
    sunny: Field

    def part(self, chosen: tuple[slice, ...]) -> Regions:
        """The same for some of the pieces."""
        return Regions(*(values[chosen] for values in vars(self).values()))


@lru_cache(maxsize=1)
def _region_fields() -> NDArray[np.float32]:
    made = [smooth_noise(_SEED, f"region {index}", _SIZE_PX, cycles) for index, cycles in enumerate(_REGION_CYCLES)]
    # Rivers wind.
    made[0] = (made[0] + np.float32(0.11) * smooth_noise(_SEED, "meanders", _SIZE_PX, 70.0)) / np.float32(1.006)
    made.append(power_noise(_SEED, "brightness", _SIZE_PX, 1.7, 10.0))
    return np.stack(made, axis=-1)


@lru_cache(maxsize=1)
def region_tile() -> MipTile:
    """Three fields whose signs separate regions, and one of brightness; of unit variance."""
    return kept_tile("regions", __file__, lambda: MipTile(_region_fields(), _TEXEL_M))


@lru_cache(maxsize=1)
def gradient_tile() -> MipTile:
    """Lengths of the gradients of the three fields. [1/m]"""
    return kept_tile("region-gradients", __file__, _gradients)


def _gradients() -> MipTile:
    fields = _region_fields()[..., :3]
    steps = [(np.roll(fields, -1, axis) - np.roll(fields, 1, axis)) / np.float32(2 * _TEXEL_M) for axis in (0, 1)]
    return MipTile(np.ascontiguousarray(np.hypot(*steps)), _TEXEL_M)


@lru_cache(maxsize=1)
def moved_tile() -> MipTile:
    """Displacements east and north of unit variance."""
    return kept_tile("moved", __file__, _moved)


def _moved() -> MipTile:
    return MipTile(np.stack([smooth_noise(_SEED, f"moved {axis}", _SIZE_PX, 34.0) for axis in "xy"], axis=-1), _TEXEL_M)


@lru_cache(maxsize=1)
def _detail() -> MipTile:
    """Tufts and clods: detail finer than the land textures."""
    return MipTile(power_noise(_SEED, "detail", 512, 1.35, 14.0)[..., None], 1.0)


class LandCover:
    """Reflectance, shadows and lamps of one environment's land.

    Args:
        environment: gives kind, colour and seed.
        rng: draws its layout.
        to_beam: (3,) unit vector towards sun or moon.
    """

    def __init__(self, environment: Environment, rng: np.random.Generator, to_beam: NDArray[np.float64]) -> None:
        self._kind = environment.ground
        self._land = _LAND_OF[self._kind]
        self._reflectance = np.array(environment.ground_reflectance_rgb)
        self._has_lines = self._kind not in ("sea", "mountains")
        self._is_low = environment.altitude_m < LOW_M
        self._shifts_m = rng.uniform(0, 1e5, (2, 8)).astype(np.float32)
        self._river_m, self._road_m = (np.float32(rng.uniform(*limits)) for limits in ((9.0, 34.0), (3.5, 7.0)))
        # Without a beam any direction will do.
        azimuth = float(np.arctan2(to_beam[1], to_beam[0]))
        self._cosine, self._sine = np.float32(np.cos(azimuth)), np.float32(np.sin(azimuth))
        self._away_x, self._away_y = -self._cosine, -self._sine
        self._tangent = np.float32(to_beam[2] / max(float(np.hypot(to_beam[0], to_beam[1])), 1e-3))
        self._weights = _weights(float(self._tangent))

    def axes(self, regions: Regions) -> Axes:
        """Where every region takes its part of the textures; their columns point to the sun."""
        signs = regions.signs > 0
        region = signs[..., 0].astype(np.intp) + 2 * signs[..., 1] + 4 * signs[..., 2]
        moved = np.float32(_WARP_M * (0.4 if self._land == "town" else 1.0)) * regions.moved
        flip = np.where(signs[..., 0] ^ signs[..., 1] ^ signs[..., 2], np.float32(-1.0), np.float32(1.0))
        east, north = moved[..., 0], moved[..., 1]
        return Axes(
            self._cosine,
            self._sine,
            flip,
            self._shifts_m[0, region] + self._cosine * east + self._sine * north,
            self._shifts_m[1, region] + flip * (self._cosine * north - self._sine * east),
        )

    def cover(self, view: GroundView, regions: Regions, axes: Axes) -> Field:
        """(H, W, 4) heights of trees, and of houses [m]; and the shares of trees, and of houses, in the plan.

        Seen from nearby, edges of woods and walls are steep.
        """
        cover = _cover(self._land, view, axes)
        if self._land == "town":
            u, v = axes.turned(view.x_m, view.y_m)
            rank = land_textures("town").beam.sample(u + axes.shift_u_m, v + axes.shift_v_m, view.across_m)[..., 3]
            # What stands in the outskirts is of the one or of the other land, not a mean of both.
            out = self._outskirts(regions, rank) > 0.5
            if out.any():
                cover = np.where(out[..., None], _cover("fields", view, axes), cover)
        if self._has_lines:
            # Nothing stands on roads and in rivers.
            away_m = _lines_away_m(regions)
            cover[(away_m[..., 0] < self._river_m) | (away_m[..., 1] < self._road_m)] = 0.0
        return cover

    def sides(self, view: GroundView, regions: Regions, seen: Seen) -> Field:
        """(H, W, 3) reflectance of edges of woods and of walls.

        Args:
            view: places on them.
            regions: there.
            seen: where rays meet them.
        """
        axes = self.axes(regions)
        # Places on an edge belong to what stands beside them.
        wide_m = np.maximum(np.float32(EDGE_REACH) * seen.distance_m, np.float32(2.0 * TEXELS_M[self._land]))
        wide = replace(view, across_m=wide_m)
        trees, houses = np.moveaxis(self.cover(wide, regions, axes)[..., 2:], -1, 0)
        u, v = axes.turned(view.x_m, view.y_m)
        over_m = seen.above_m - regions.above_m
        # Two oblique cuts, for along an edge that runs as a cut leans there is no change but upwards.
        leaves = sum(
            _noise_at(u + np.float32(lean) * over_m, v + over_m, _FOLIAGE_TEXEL_M, view.across_m) for lean in (-1, 1)
        )
        foliage = _FOLIAGE * np.maximum(1.0 + np.float32(_FOLIAGE_CONTRAST) * leaves, np.float32(0.2))[..., None]
        # Windows of storeys; walls stand along u or v, more or less, so that the sum goes along them.
        window = _within(over_m, _STOREY_M, 0.5, view.across_m) * _within(u + v, _WINDOW_SPACING_M, 0.45, view.across_m)
        tone = _noise_at(u, v, _HOUSES_TEXEL_M, view.across_m)[..., None]
        wall = _WALL * np.maximum(1.0 + tone * _WALL_TONE, np.float32(0.3)) * (1.0 - _GLASS * window[..., None])
        built = (houses / np.maximum(trees + houses, np.float32(1e-3)))[..., None]
        result: Field = foliage + built * (wall - foliage)
        return result

    def seen(self, view: GroundView, regions: Regions, lit_lamps: float) -> tuple[Field, Field, Field | None]:
        """Reflectance, light of the beam over that on level ground, and lamps.

        Args:
            view: pieces of the land.
            regions: there.
            lit_lamps: share of the lamps' light, 0 by day.

        Returns:
            (H, W, 3), (H, W), and (H, W, 3) radiance of lamps [cd/m2] or None.
        """
        axes, textures = self.axes(regions), land_textures(self._land)
        rgb, beam = view.average(textures.rgb, textures.beam, axes=axes)
        albedo = rgb * (self._reflectance / textures.rgb.mean).astype(np.float32)
        lamps = None
        if lit_lamps > 0:
            lamps = self._lamps(self._land, view, axes)
            if self._land == "town":
                # The outskirts are darker.
                inner = regions.signs[..., 0] + np.float32(0.25) * regions.signs[..., 3]
                lamps = lamps * _ramp(inner, _TOWN_ABOVE - 0.3, 0.8)[..., None]
        if self._land == "town":
            out = self._outskirts(regions, beam[..., 3])
            if out.any():
                far = land_textures("fields")
                rgb, rural_beam = view.average(far.rgb, far.beam, axes=axes)
                share = out[..., None]
                albedo = albedo + share * (rgb - albedo)
                if lamps is not None:
                    lamps = lamps + share * (self._lamps("fields", view, axes) - lamps)
                beam = beam + share * (rural_beam - beam)
        if self._kind == "mountains":
            albedo = self._alpine(albedo, regions)
        elif self._kind == "snow":
            albedo = _snowed(albedo)
        sunlit = (beam[..., :3] @ self._weights) * np.float32(BEAM_SCALE)
        albedo, sunlit = self._lines(albedo, sunlit, view, regions)
        tone = np.float32(_TONE) * regions.signs[..., 3:] * np.array([1.0, 0.0, -1.0], dtype=np.float32)
        brightness = np.clip(1.0 + np.float32(_BRIGHTNESS) * regions.signs[..., 3], 0.5, 1.6) * self.detail(view)
        albedo = albedo * ((1.0 + tone) * brightness[..., None])
        if self._land == "fields" and not self._is_low and self._kind != "snow":
            # A hedge hides ground over a length of its height over the sine of the ray's elevation.
            behind = np.exp(np.float32(-_HEDGE_M / _HEDGE_SPACING_M) / view.sine)[..., None]
            side = np.float32(1.4) * _WOOD
            albedo = side + behind * (albedo - side)
        if lamps is not None:
            lamps = lamps * np.float32(lit_lamps)
        return albedo, sunlit, lamps

    def _lamps(self, land: LandKind, view: GroundView, axes: Axes) -> Field:
        tile = lamp_texture(land)
        light = view.average(tile, axes=axes)[0]
        # What lamps light around the street, and the haze over the place.
        u, v = axes.turned(view.x_m, view.y_m)
        wide = np.maximum(view.across_m, np.float32(90.0))
        glow = tile.sample(u + axes.shift_u_m, v + axes.shift_v_m, wide)
        result: Field = np.float32(LAMP_PEAK_CD_M2) * (np.float32(0.85) * light + np.float32(0.15) * glow)
        return result

    def _outskirts(self, regions: Regions, rank: Field) -> Field:
        """(H, W) share of fields: towns end block by block."""
        edge = regions.signs[..., 0] + np.float32(0.25) * regions.signs[..., 3] + np.float32(0.7) * (rank - 0.5)
        share: Field = np.clip((np.float32(_TOWN_ABOVE) - edge) / np.float32(_TOWN_EDGE) + np.float32(0.5), 0.0, 1.0)
        return share

    def _alpine(self, albedo: Field, regions: Regions) -> Field:
        """Forest in valleys, meadows above, rock where it is steep and snow on top."""
        steep = np.hypot(regions.slopes[..., 0], regions.slopes[..., 1])
        ragged = np.float32(70.0) * regions.signs[..., 3] + np.float32(60.0) * regions.moved[..., 0]
        texture = albedo.mean(axis=-1, keepdims=True)
        texture = np.clip(texture / np.float32(self._reflectance.mean()), 0.4, 1.8)
        meadow = _ramp(regions.above_m + ragged, 30.0, 140.0)[..., None]
        albedo = albedo + meadow * (_MEADOW * (0.7 + 0.3 * texture) - albedo)
        rock = np.maximum(_ramp(steep, 0.5, 0.75), _ramp(regions.above_m + ragged, 200.0, 380.0))[..., None]
        albedo = albedo + rock * (_ROCK * (0.55 + 0.45 * texture) - albedo)
        snow = (_ramp(regions.above_m + 1.5 * ragged, 210.0, 520.0) * (1.0 - 0.85 * _ramp(steep, 0.5, 0.9)))[..., None]
        result: Field = albedo + snow * (np.float32(0.92) * _SNOW - albedo)
        return result

    def _lines(self, albedo: Field, sunlit: Field, view: GroundView, regions: Regions) -> tuple[Field, Field]:
        """Rivers, roads and belts of trees along the edges of regions."""
        if not self._has_lines:
            return albedo, sunlit
        blur_m = np.sqrt(view.across_m * view.along_m)
        away_m = _lines_away_m(regions)
        bank, road = (np.float32(half) for half in (14.0, 8.0))
        if self._kind == "dry":
            bed = inside_share(away_m[..., 0], self._river_m * 1.6, blur_m)[..., None]
            track = inside_share(away_m[..., 1], self._road_m * 0.8, blur_m)[..., None]
            bed = np.maximum(bed, np.float32(0.8) * inside_share(away_m[..., 2], 13.0, blur_m)[..., None])
            albedo = albedo + np.float32(0.7) * bed * (_BED - albedo)
            return albedo + np.float32(0.6) * track * (np.float32(0.9) * _BED - albedo), sunlit
        # Belts of trees have gaps.
        belt = _ramp(regions.moved[..., 0], 0.2, 0.5) * inside_share(away_m[..., 2], 10.0, blur_m)
        banks = np.float32(0.7) * inside_share(away_m[..., 0], self._river_m + bank, blur_m)
        trees = np.maximum(belt, banks)
        verge = inside_share(away_m[..., 1], self._road_m + road, blur_m)
        paved = inside_share(away_m[..., 1], self._road_m, blur_m)
        water = inside_share(away_m[..., 0], self._river_m, blur_m)
        if self._kind == "airfield":
            water = np.zeros_like(water)
        albedo = albedo + trees[..., None] * (_WOOD * (_SNOW if self._kind == "snow" else 1.0) - albedo)
        if self._kind != "snow":
            albedo = albedo + np.float32(0.5) * verge[..., None] * (_MEADOW - albedo)
        albedo = albedo + paved[..., None] * (_ROAD - albedo)
        albedo = albedo + water[..., None] * (self._water(view) - albedo)
        flat = np.maximum(paved, water)
        return albedo, sunlit + np.maximum(flat, np.float32(0.6) * trees) * (1.0 - sunlit)

    def _water(self, view: GroundView) -> Field:
        """(H, W, 3) reflectance of a river, the mirrored sky included, as if the sky were even."""
        mirrored = np.asarray(fresnel(np.clip(view.sine, 0.02, 1.0)), dtype=np.float32)
        result: Field = _WATER + mirrored[..., None] * np.array([0.24, 0.27, 0.32], dtype=np.float32)
        return result

    def crowns(self, view: GroundView) -> Field:
        """(H, W) how much crowns of trees stand out, of unit variance."""
        return _noise_at(view.x_m, view.y_m, _CROWN_TEXEL_M, view.across_m)

    def patches(self, view: GroundView) -> Field:
        """(H, W) ragged forms of some 200 m, of unit variance."""
        return _noise_at(view.x_m, view.y_m, _PATCH_TEXEL_M, view.across_m)

    def detail(self, view: GroundView) -> Field:
        """(H, W) factor of unit mean: tufts and clods."""
        finest_m = float(view.across_m.min())
        total = np.ones_like(view.x_m)
        for texel_m, strength in _DETAIL:
            if finest_m > _DETAIL_SPAN * texel_m:
                continue
            scale = np.float32(1.0 / texel_m)
            near = GroundView(
                view.x_m * scale, view.y_m * scale, view.away_x, view.away_y, view.sine,
                view.across_m * scale, view.along_m * scale, view.places,
            )  # fmt: skip
            total = total + np.float32(strength) * near.average(_detail())[0][..., 0]
        result: Field = np.maximum(total, np.float32(0.3))
        return result


LOW_M = 150.0
"""Altitude below which trees and houses stand up from the ground. [m]"""
EDGE_REACH = 0.025
"""An edge of what stands there is found to this share of its distance."""


def _weights(tangent: float) -> NDArray[np.float32]:
    """(3,) weights of the stored shares of light for one tangent of the sun's elevation."""
    place = float(np.interp(np.log(max(tangent, 1e-3)), np.log(SUN_TANGENTS), np.arange(len(SUN_TANGENTS))))
    weights = np.maximum(1.0 - np.abs(np.arange(len(SUN_TANGENTS)) - place), 0.0)
    return np.asarray(weights, dtype=np.float32)


def _noise_at(x_m: Field, y_m: Field, texel_m: float, width_m: Field) -> Field:
    """(H, W) noise of texels of a size, of unit variance, averaged over widths. [m]"""
    scale = np.float32(1.0 / texel_m)
    return _detail().sample(x_m * scale, y_m * scale, width_m * scale)[..., 0]


def _lines_away_m(regions: Regions) -> Field:
    """(H, W, 3) distances from the middles of rivers, of roads, and of belts of trees. [m]"""
    away_m: Field = np.abs(regions.signs[..., :3]) / np.maximum(regions.per_m, np.float32(1.5e-4))
    return away_m


def _within(place_m: Field, period_m: float, share: float, blur_m: Field) -> Field:
    """(H, W) blurred square wave: 1 in the middle `share` of each period, and 0 between."""
    away = np.abs(place_m / np.float32(period_m) - np.floor(place_m / np.float32(period_m)) - np.float32(0.5))
    blur = np.maximum(blur_m / np.float32(period_m), np.float32(0.02))
    sharp = np.clip((np.float32(0.5 * share) - away) / blur + np.float32(0.5), 0.0, 1.0)
    mean = np.clip(blur * 2.0 - 0.5, 0.0, 1.0)
    result: Field = sharp + mean * (np.float32(share) - sharp)
    return result


def _cover(land: LandKind, view: GroundView, axes: Axes) -> Field:
    """(H, W, 4) as `LandCover.cover` gives it, of one kind of land."""
    u, v = axes.turned(view.x_m, view.y_m)
    cover = land_textures(land).cover.sample(u + axes.shift_u_m, v + axes.shift_v_m, view.across_m)
    near = np.clip(np.float32(2.0) - view.across_m / np.float32(TEXELS_M[land]), 0.0, 1.0)[..., None]
    shares = cover[..., 2:]
    steep = np.clip((shares - np.float32(0.5)) * (1.0 + np.float32(_EDGE_STEEPNESS) * near) + np.float32(0.5), 0.0, 1.0)
    cover[..., :2] *= np.float32(HEIGHT_SCALE_M) * steep / np.maximum(shares, np.float32(1e-2))
    return cover


def _ramp(value: Field, low: float, high: float) -> Field:
    result: Field = np.clip((value - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return result


def _snowed(albedo: Field) -> Field:
    """Fields under snow; woods, which are darker, stand out of it."""
    open_ = _ramp(albedo.mean(axis=-1), 0.030, 0.055)[..., None]
    texture = np.clip(albedo.mean(axis=-1, keepdims=True) / np.float32(0.08), 0.6, 1.4)
    wood = np.float32(1.5) * albedo + np.float32(0.03)
    result: Field = wood + open_ * (_SNOW * (0.86 + 0.12 * texture) - wood)
    return result


def enlarged(coarse: Field, every: int, shape: tuple[int, int]) -> Field:
    """(H, W, ...) fields from their values at the centres of squares of pixels."""
    full = cv2.resize(coarse, None, fx=every, fy=every, interpolation=cv2.INTER_LINEAR)
    result: Field = full[: shape[0], : shape[1]]
    return result
