"""Textures of land from above: fields, forest, dry land and town, 8 km wide, painted once for all scenes.

Reflectances are our choice within published ranges (linear Rec. 709). Scenes differ by position, rotation and colour
of the textures.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from geometry.bilinear_sampling import sample_bilinear
from scenes.ground_view import Field, MipTile, power_noise, smooth_noise

LandKind = Literal["fields", "forest", "dry", "town"]
Rgb = tuple[float, float, float]
Rectangle = tuple[int, int, int, int]

_SIZE_PX, _TEXEL_M = 2048, 4.0
_TOWN_TEXEL_M = 2.5
_SEED = 4

_CROPS: tuple[tuple[float, Rgb], ...] = (
    (0.18, (0.215, 0.175, 0.085)),  # ripe grain
    (0.20, (0.062, 0.098, 0.030)),
    (0.20, (0.085, 0.118, 0.045)),  # grass
    (0.13, (0.043, 0.072, 0.024)),
    (0.14, (0.125, 0.092, 0.064)),  # ploughed
    (0.08, (0.185, 0.150, 0.105)),
    (0.015, (0.260, 0.240, 0.050)),  # rape in flower
)
_WOOD: Rgb = (0.026, 0.038, 0.017)
_ROAD: Rgb = (0.16, 0.155, 0.145)
_ASPHALT: Rgb = (0.085, 0.085, 0.088)
_RED_ROOF: Rgb = (0.42, 0.045, 0.035)
_ROOFS: tuple[Rgb, ...] = (
    (0.22, 0.100, 0.070),
    (0.19, 0.085, 0.060),
    (0.17, 0.095, 0.075),
    (0.12, 0.115, 0.110),
    (0.15, 0.145, 0.135),
    (0.30, 0.295, 0.285),
    (0.24, 0.225, 0.200),
    (0.07, 0.070, 0.075),
    (0.09, 0.085, 0.085),
    (0.48, 0.470, 0.450),
    _RED_ROOF,
)


@lru_cache(maxsize=4)
def land_tile(kind: LandKind) -> MipTile:
    """The texture of a kind of land: reflectance, and as the fourth channel the density of lamps lit at night."""
    paint = {"fields": _paint_fields, "forest": _paint_forest, "dry": _paint_dry, "town": _paint_town}[kind]
    rng = frame_generator(_SEED, 0, f"paint {kind}")
    canvas = np.clip(paint(rng), 0.0, 1.0)
    return MipTile(canvas, _TOWN_TEXEL_M if kind == "town" else _TEXEL_M, coded=True)


def _rgb(red: float, green: float, blue: float) -> NDArray[np.float32]:
    return np.array((red, green, blue), dtype=np.float32)


def _noise(stream: str, slope: float, cycles: float) -> Field:
    """(2048, 2048) texture that repeats one of half its width."""
    return np.tile(power_noise(_SEED, stream, _SIZE_PX // 2, slope, cycles / 2), (2, 2))


def _smooth(stream: str, cycles: float) -> Field:
    return np.tile(smooth_noise(_SEED, stream, _SIZE_PX // 2, cycles / 2), (2, 2))


def _bent(canvas: Field, stream: str, amplitude_px: float, cycles: float) -> Field:
    """The texture with its straight lines bent."""
    v, u = np.meshgrid(np.arange(_SIZE_PX, dtype=np.float32), np.arange(_SIZE_PX, dtype=np.float32), indexing="ij")
    u += np.float32(amplitude_px) * _smooth(f"{stream} u", cycles)
    v += np.float32(amplitude_px) * _smooth(f"{stream} v", cycles)
    size = np.float32(_SIZE_PX)
    bent: Field = sample_bilinear(canvas, np.mod(u, size), np.mod(v, size), cv2.BORDER_WRAP)
    return bent


def _parcels(rng: np.random.Generator, smallest_px: float, largest_px: float) -> list[tuple[Rectangle, int]]:
    """Rectangles (left, top, right, bottom) that tile the texture, and how often each was divided."""
    done: list[tuple[Rectangle, int]] = []
    left = [((0, 0, _SIZE_PX, _SIZE_PX), 0)]
    while left:
        (x0, y0, x1, y1), depth = left.pop()
        width, height = x1 - x0, y1 - y0
        if max(width, height) < rng.uniform(smallest_px, largest_px) or min(width, height) < 8:
            done.append(((x0, y0, x1, y1), depth))
            continue
        share = rng.uniform(0.32, 0.68)
        if width > height * rng.uniform(0.7, 1.4):
            cut = x0 + round(share * width)
            left += [((x0, y0, cut, y1), depth + 1), ((cut, y0, x1, y1), depth + 1)]
        else:
            cut = y0 + round(share * height)
            left += [((x0, y0, x1, cut), depth + 1), ((x0, cut, x1, y1), depth + 1)]
    return done


def _fill(canvas: Field, area: Rectangle, color: Rgb | NDArray[np.float64], lamps: float = 0.0) -> None:
    x0, y0, x1, y1 = area
    canvas[y0:y1, x0:x1] = (*color, lamps)


def _house(canvas: Field, rng: np.random.Generator, x: int, y: int, sizes_px: tuple[int, int]) -> None:
    width, height = rng.integers(sizes_px[0], sizes_px[1] + 1, 2)
    roof = np.array(_ROOFS[int(rng.integers(len(_ROOFS)))]) * rng.uniform(0.75, 1.2)
    _fill(canvas, (x, y, x + int(width), y + int(height)), roof)


def _paint_fields(rng: np.random.Generator) -> Field:
    canvas = np.zeros((_SIZE_PX, _SIZE_PX, 4), dtype=np.float32)
    wood = np.zeros((_SIZE_PX, _SIZE_PX), dtype=np.float32)
    shares = np.cumsum([share for share, _ in _CROPS])
    parcels = _parcels(rng, 26, 95)
    stripes = (1.0 + 0.05 * np.sin(np.arange(_SIZE_PX) * (2 * np.pi / 5.3))).astype(np.float32)
    for area, _ in parcels:
        x0, y0, x1, y1 = area
        place = rng.random()
        index = int(np.searchsorted(shares, place))
        if index == len(_CROPS):
            wood[y0:y1, x0:x1] = 1.0
            continue
        _fill(canvas, area, np.array(_CROPS[index][1]) * rng.uniform(0.75, 1.2) * rng.uniform(0.94, 1.06, 3))
        canvas[y0:y1, x0:x1, :3] *= (
            stripes[None, : x1 - x0, None] if rng.random() < 0.5 else stripes[: y1 - y0, None, None]
        )
    canvas[..., :3] *= (1.0 + 0.08 * _noise("soil", 1.3, 40))[..., None]
    for (x0, y0, x1, y1), depth in parcels:
        if depth <= 8 and rng.random() < 0.25:
            _fill(canvas, (x0, y0, x1, y0 + 2), _ROAD, 0.002)
        elif rng.random() < 0.5:
            wood[y0 : y0 + int(rng.integers(1, 4)), x0:x1] = 1.0
        if depth <= 7 and rng.random() < 0.25:
            _fill(canvas, (x0, y0, x0 + 2, y1), _ROAD, 0.002)
        elif rng.random() < 0.5:
            wood[y0:y1, x0 : x0 + int(rng.integers(1, 4))] = 1.0
    _villages(canvas, wood, rng)
    wood = np.maximum(wood, (_noise("copse", 2.0, 60) > 2.3).astype(np.float32))
    wood = _bent(wood, "fringe", 1.3, 160)
    crowns = np.clip(1.0 + 0.45 * _noise("crowns", 0.6, 500), 0.3, 2.2)
    trees = np.array(_WOOD, dtype=np.float32) * crowns[..., None]
    canvas[..., :3] += wood[..., None] * (trees - canvas[..., :3])
    return _bent(canvas, "bend", 6.5, 12)


def _villages(canvas: Field, wood: Field, rng: np.random.Generator) -> None:
    for _ in range(26):
        cx, cy = rng.integers(150, _SIZE_PX - 150, 2)
        spread = rng.uniform(4, 45)
        for _ in range(int(2 + spread * rng.uniform(1.0, 3.0))):
            x, y = (int(value) for value in rng.normal((cx, cy), spread))
            if rng.random() < 0.5:
                wood[y : y + 4, x : x + 5] = 1.0
            else:
                wood[y - 1 : y + 5, x - 1 : x + 5] = 0.0
                canvas[y - 1 : y + 5, x - 1 : x + 5, 3] = 0.05
                _house(canvas, rng, x, y, (2, 4))
    for _ in range(24):  # barns and halls
        x, y = rng.integers(20, _SIZE_PX - 20, 2)
        _fill(canvas, (x, y, x + int(rng.integers(5, 14)), y + int(rng.integers(4, 7))), _RED_ROOF)


def _paint_forest(rng: np.random.Generator) -> Field:
    canvas = np.zeros((_SIZE_PX, _SIZE_PX, 4), dtype=np.float32)
    stands = _bent(_blocks(rng, 40, 170), "stands", 12.0, 24)
    needles, leaves = _rgb(0.022, 0.033, 0.016), _rgb(0.042, 0.064, 0.022)
    mix = np.clip(0.5 + 0.3 * (stands - 0.5) / 0.29 + 0.25 * _noise("mix", 1.5, 30), 0, 1)[..., None]
    canvas[..., :3] = needles + mix * (leaves - needles)
    crowns = np.clip(1.0 + 0.30 * _noise("canopy", 0.4, 500), 0.35, 2.0) * (1.0 + 0.10 * _noise("age", 1.4, 50))
    canvas[..., :3] *= crowns[..., None]
    cleared = (_bent(_blocks(rng, 25, 80), "cleared", 4.0, 30) > 0.955)[..., None]
    soil = _rgb(0.105, 0.098, 0.052) * (1.0 + 0.12 * _noise("clearing", 1.2, 60))[..., None]
    np.copyto(canvas[..., :3], soil, where=cleared)
    canvas[np.abs(_smooth("forest track", 8)) < 0.012] = (0.14, 0.125, 0.095, 0.0)
    return canvas


def _blocks(rng: np.random.Generator, smallest_px: float, largest_px: float) -> Field:
    """(2048, 2048) a random number in [0, 1) for each parcel."""
    values = np.zeros((_SIZE_PX, _SIZE_PX), dtype=np.float32)
    for (x0, y0, x1, y1), _ in _parcels(rng, smallest_px, largest_px):
        values[y0:y1, x0:x1] = rng.random()
    return values


def _paint_dry(rng: np.random.Generator) -> Field:
    canvas = np.zeros((_SIZE_PX, _SIZE_PX, 4), dtype=np.float32)
    sand, rock, pale = _rgb(0.255, 0.190, 0.125), _rgb(0.150, 0.108, 0.078), _rgb(0.36, 0.305, 0.235)
    stony = np.clip(0.5 + 0.45 * _noise("stony", 1.5, 12), 0, 1)[..., None]
    canvas[..., :3] = sand + stony * (rock - sand)
    flats = np.clip(1.6 * (_noise("flats", 1.9, 10) - 1.3), 0, 1)[..., None]
    canvas[..., :3] += flats * (pale - canvas[..., :3])
    lines = np.abs(0.9 * _smooth("wadi", 7) + 0.25 * _noise("gully", 1.7, 30))
    canvas[..., :3] *= (1.0 + 0.35 * np.exp(-((lines / 0.035) ** 2)))[..., None]
    scrub = np.clip(_noise("scrub", 0.5, 400) - 1.4 + 0.9 * np.exp(-((lines / 0.12) ** 2)), 0, 1)[..., None]
    canvas[..., :3] += scrub * (_rgb(0.055, 0.062, 0.033) - canvas[..., :3])
    canvas[..., :3] *= (1.0 + 0.07 * _noise("grit", 0.7, 300))[..., None]
    canvas[np.abs(_smooth("dry track", 4)) < 0.008, :3] = pale * np.float32(0.9)
    for _ in range(14):
        x, y = (int(value) for value in rng.integers(30, _SIZE_PX - 30, 2))
        for _ in range(int(rng.integers(1, 9))):
            dx, dy = (int(value) for value in rng.integers(-14, 15, 2))
            canvas[y + dy - 1 : y + dy + 5, x + dx - 1 : x + dx + 5, 3] = 0.03
            _house(canvas, rng, x + dx, y + dy, (2, 5))
    return canvas


def _paint_town(rng: np.random.Generator) -> Field:
    canvas = np.zeros((_SIZE_PX, _SIZE_PX, 4), dtype=np.float32)
    _fill(canvas, (0, 0, _SIZE_PX, _SIZE_PX), _ASPHALT, 0.5)
    green = _rgb(0.060, 0.080, 0.034)
    for (x0, y0, x1, y1), depth in _parcels(rng, 22, 60):
        street = 3 if depth > 9 else 5
        block = (x0 + street, y0 + street, x1, y1)
        if block[2] - block[0] < 4 or block[3] - block[1] < 4:
            continue
        kind = rng.random()
        if kind < 0.10:
            _fill(canvas, block, green * rng.uniform(0.7, 1.2))
        elif kind < 0.30:
            _fill(canvas, block, np.full(3, rng.uniform(0.10, 0.22)), 0.12)
            _lots(canvas, rng, block, (10, 26), 3)
        elif kind < 0.65:
            _fill(canvas, block, (0.12, 0.115, 0.105), 0.15)
            _lots(canvas, rng, block, (5, 10), 1)
        else:
            _fill(canvas, block, green * rng.uniform(0.8, 1.3), 0.08)
            _lots(canvas, rng, block, (4, 7), 2)
    canvas[_noise("street trees", 0.5, 500) > 1.75, :3] = _WOOD
    canvas[..., :3] *= (1.0 + 0.10 * _noise("wear", 0.8, 200))[..., None]
    # Lamps are apart: each lights its own spot of the street.
    spots = np.clip(_noise("lamps", 0.2, 500) - 1.9, 0, 1)
    canvas[..., 3] *= 0.003 + spots
    return _bent(canvas, "town", 6.0, 6)


def _lots(canvas: Field, rng: np.random.Generator, block: Rectangle, sizes_px: tuple[int, int], gap_px: int) -> None:
    """Buildings in rows over a block."""
    x0, y0, x1, y1 = block
    y = y0 + 1
    while y < y1 - sizes_px[0]:
        deep = int(rng.integers(sizes_px[0], sizes_px[1] + 1))
        x = x0 + 1
        while x < x1 - sizes_px[0]:
            wide = int(rng.integers(sizes_px[0], sizes_px[1] + 1))
            area = (x, y, min(x + wide, x1 - 1), min(y + deep, y1 - 1))
            if rng.random() < 0.9:
                roof = np.array(_ROOFS[int(rng.integers(len(_ROOFS)))]) * rng.uniform(0.7, 1.2)
                _fill(canvas, area, roof, 0.02)
                ridge = (area[1] + area[3]) // 2  # the far side of a gabled roof is darker
                canvas[ridge : area[3], area[0] : area[2], :3] *= rng.uniform(0.7, 0.95)
            x += wide + gap_px
        y += deep + gap_px
