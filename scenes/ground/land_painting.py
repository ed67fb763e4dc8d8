"""Paints land as seen from above: fields, forest, dry land and town, with heights of trees and houses.

Reflectances are our choice within published ranges (linear Rec. 709).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from geometry.bilinear_sampling import sample_bilinear
from scenes.ground_view import Field, power_noise, smooth_noise

LandKind = Literal["fields", "forest", "dry", "town"]
Rgb = tuple[float, float, float]
Rectangle = tuple[int, int, int, int]

SIZE_PX = 2048
TEXELS_M: dict[LandKind, float] = {"fields": 4.0, "forest": 4.0, "dry": 4.0, "town": 2.5}
# Streams, amplitudes [px] and cycles by which straight lines are bent at last.
_BENDS: dict[LandKind, tuple[tuple[str, float, float], ...]] = {
    "fields": (("valleys", 19.0, 5), ("bend", 5.0, 14)), "forest": (), "dry": (), "town": (("town", 7.0, 3),),
}  # fmt: skip
SEED = 4

_CROPS: tuple[tuple[float, Rgb], ...] = (
    (0.17, (0.165, 0.135, 0.075)), (0.24, (0.062, 0.090, 0.032)), (0.26, (0.078, 0.104, 0.044)),
    (0.12, (0.046, 0.070, 0.026)), (0.11, (0.112, 0.086, 0.062)), (0.09, (0.150, 0.124, 0.086)),
    (0.01, (0.215, 0.200, 0.052)),
)  # fmt: skip
_WOOD: Rgb = (0.025, 0.036, 0.017)
_ROAD: Rgb = (0.145, 0.138, 0.125)
_ASPHALT: Rgb = (0.088, 0.087, 0.086)
_RED_ROOF: Rgb = (0.34, 0.045, 0.035)
# Roofs of one district resemble each other.
_ROOFS: tuple[tuple[Rgb, ...], ...] = (
    ((0.145, 0.080, 0.058), (0.165, 0.095, 0.070), (0.125, 0.082, 0.066)),
    ((0.100, 0.096, 0.094), (0.075, 0.074, 0.076), (0.125, 0.108, 0.096)),
    ((0.160, 0.152, 0.142), (0.120, 0.116, 0.112), (0.205, 0.198, 0.188)),
)
_HALLS: tuple[Rgb, ...] = ((0.24, 0.235, 0.225), (0.17, 0.17, 0.172), (0.32, 0.315, 0.305), (0.15, 0.115, 0.10))
_LAMP_SPACING_M = 32.0


@dataclass
class Canvas:
    """A texture in work.

    Attributes:
        rgb: (N, N, 3) reflectance.
        height_m: (N, N) of trees and houses.
        built, wooded: (N, N) shares of houses, and of trees.
        rank: (N, N) a random number for each parcel.
        texel_m: size of a texel.
        lamps_px: places of street lamps.
    """

    rgb: Field
    height_m: Field
    built: Field
    wooded: Field
    rank: Field
    texel_m: float
    lamps_px: list[tuple[float, float]] = field(default_factory=list)

    def fill(self, area: Rectangle, color: Rgb | NDArray[np.float64], height_m: float = 0.0) -> None:
        """One colour and height in a rectangle; what has a height is a house."""
        x0, y0, x1, y1 = area
        self.rgb[y0:y1, x0:x1] = color
        self.height_m[y0:y1, x0:x1] = height_m
        self.built[y0:y1, x0:x1] = float(height_m > 0.0)
        self.wooded[y0:y1, x0:x1] = 0.0

    def lamps_along(self, start_px: tuple[int, int], length_px: int, is_column: bool) -> None:
        """Lamps along a street, on alternate sides."""
        step = _LAMP_SPACING_M / self.texel_m
        for index in range(int(length_px / step)):
            if index % 7 == (start_px[0] + start_px[1]) % 7:
                continue  # hidden by trees
            along, across = (index + 0.5) * step, 0.6 * (-1) ** index
            x, y = (across, along) if is_column else (along, across)
            self.lamps_px.append((start_px[0] + x, start_px[1] + y))


def painted_land(kind: LandKind) -> Canvas:
    """The texture of a kind of land, its straight lines bent."""
    paint = {"fields": _paint_fields, "forest": _paint_forest, "dry": _paint_dry, "town": _paint_town}[kind]
    shape = (SIZE_PX, SIZE_PX)
    empty = Canvas(
        rgb=np.zeros((*shape, 3), dtype=np.float32),
        height_m=np.zeros(shape, dtype=np.float32),
        built=np.zeros(shape, dtype=np.float32),
        wooded=np.zeros(shape, dtype=np.float32),
        rank=np.full(shape, 0.5, dtype=np.float32),
        texel_m=TEXELS_M[kind],
    )
    paint(empty, frame_generator(SEED, 0, f"paint {kind}"))
    for bend in _BENDS[kind]:
        empty.rgb = _bent(empty.rgb, *bend)
        cover = _bent(np.stack([empty.height_m, empty.built, empty.wooded, empty.rank], axis=-1), *bend)
        empty.height_m, empty.built, empty.wooded, empty.rank = (cover[..., index].copy() for index in range(4))
    return empty


def _rgb(red: float, green: float, blue: float) -> NDArray[np.float32]:
    return np.array((red, green, blue), dtype=np.float32)


def _noise(stream: str, slope: float, cycles: float) -> Field:
    """(2048, 2048) texture that repeats one of half its width."""
    return np.tile(power_noise(SEED, stream, SIZE_PX // 2, slope, cycles / 2), (2, 2))


def smooth(stream: str, cycles: float) -> Field:
    """(2048, 2048) texture of a single scale that repeats one of half its width."""
    return np.tile(smooth_noise(SEED, stream, SIZE_PX // 2, cycles / 2), (2, 2))


def _bent(canvas: Field, stream: str, amplitude_px: float, cycles: float) -> Field:
    """The texture with its straight lines bent."""
    v, u = np.meshgrid(np.arange(SIZE_PX, dtype=np.float32), np.arange(SIZE_PX, dtype=np.float32), indexing="ij")
    u += np.float32(amplitude_px) * smooth(f"{stream} u", cycles)
    v += np.float32(amplitude_px) * smooth(f"{stream} v", cycles)
    size = np.float32(SIZE_PX)
    bent: Field = sample_bilinear(canvas, np.mod(u, size), np.mod(v, size), cv2.BORDER_WRAP)
    return bent


def bent_like(kind: LandKind, texture: Field) -> Field:
    """A texture bent as the land of a kind is."""
    for bend in _BENDS[kind]:
        texture = _bent(texture, *bend)
    return texture


def _parcels(
    rng: np.random.Generator, smallest_px: float, largest_px: float, area: Rectangle = (0, 0, SIZE_PX, SIZE_PX)
) -> list[tuple[Rectangle, int]]:
    """Rectangles (left, top, right, bottom) that tile an area, and how often each was divided."""
    done: list[tuple[Rectangle, int]] = []
    left = [(area, 0)]
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


def _plots(rng: np.random.Generator, area: Rectangle) -> list[Rectangle]:
    """Strips of a block of fields, side by side, some of them divided."""
    x0, y0, x1, y1 = area
    is_column = bool(rng.random() < 0.5)
    low, high = (x0, x1) if is_column else (y0, y1)
    typical = rng.uniform(16, 52)
    plots: list[Rectangle] = []
    while low < high:
        end = min(low + round(typical * rng.uniform(0.6, 1.5)), high)
        if high - end < 8:
            end = high
        strip = (low, y0, end, y1) if is_column else (x0, low, x1, end)
        length = (strip[3] - strip[1]) if is_column else (strip[2] - strip[0])
        if length > 60 and rng.random() < 0.5:
            cut = round(length * rng.uniform(0.3, 0.7))
            one = (strip[0], strip[1], strip[2], strip[1] + cut) if is_column else (x0, low, x0 + cut, end)
            two = (strip[0], strip[1] + cut, strip[2], strip[3]) if is_column else (x0 + cut, low, x1, end)
            plots += [one, two]
        else:
            plots.append(strip)
        low = end
    return plots


def _paint_fields(canvas: Canvas, rng: np.random.Generator) -> None:
    wood = np.zeros((SIZE_PX, SIZE_PX), dtype=np.float32)
    woods = _noise("woods", 2.3, 11)
    shares = np.cumsum([share for share, _ in _CROPS])
    blocks = _parcels(rng, 90, 250)
    stripes = (1.0 + 0.035 * np.sin(np.arange(SIZE_PX) * (2 * np.pi / 5.3))).astype(np.float32)
    for area, _ in blocks:
        x0, y0, x1, y1 = area
        wooded = woods[(y0 + y1) // 2, (x0 + x1) // 2]
        if wooded > 1.0:
            wood[y0:y1, x0:x1] = 1.0
            canvas.fill(area, _WOOD)
            canvas.rank[y0:y1, x0:x1] = rng.random()
            continue
        # A block grows few crops.
        crops = [min(int(np.searchsorted(shares, rng.random())), len(_CROPS) - 1) for _ in range(3)]
        for plot in _plots(rng, area):
            px0, py0, px1, py1 = plot
            if wooded > 0.4 and rng.random() < 0.25:
                wood[py0:py1, px0:px1] = 1.0
                continue
            crop = crops[int(rng.integers(3))]
            canvas.fill(plot, np.array(_CROPS[crop][1]) * rng.uniform(0.85, 1.15) * rng.uniform(0.96, 1.04, 3))
            canvas.rank[py0:py1, px0:px1] = rng.random()
            rows = stripes[None, : px1 - px0, None] if rng.random() < 0.5 else stripes[: py1 - py0, None, None]
            canvas.rgb[py0:py1, px0:px1] *= rows
            # Headlands and ditches.
            canvas.rgb[py0, px0:px1] *= 0.82
            canvas.rgb[py0:py1, px0] *= 0.82
    soil = 0.11 * _noise("soil", 1.7, 16) + 0.05 * _noise("soil fine", 1.2, 90)
    canvas.rgb *= np.clip(1.0 + soil, 0.6, 1.5)[..., None]
    for (x0, y0, x1, y1), depth in blocks:
        wide = 2 if depth <= 5 else 1
        if rng.random() < 0.5:
            canvas.fill((x0, y0, x1, y0 + wide), _ROAD)
        elif rng.random() < 0.45:
            wood[y0 : y0 + int(rng.integers(1, 4)), x0:x1] = 1.0
        if rng.random() < 0.5:
            canvas.fill((x0, y0, x0 + wide, y1), _ROAD)
        elif rng.random() < 0.45:
            wood[y0:y1, x0 : x0 + int(rng.integers(1, 4))] = 1.0
    _villages(canvas, wood, [area for area, _ in blocks], rng)
    wood = np.maximum(wood, (woods + 0.35 * _noise("copse", 1.8, 60) > 1.75).astype(np.float32))
    gaps = _noise("gaps", 1.2, 260)
    wood *= np.clip(1.6 + gaps, 0.0, 1.0)
    wood = _bent(wood, "fringe", 2.0, 170)
    _plant(canvas, wood, "crowns")


def _plant(canvas: Canvas, wood: Field, stream: str, height_m: float = 13.0) -> None:
    """Trees where `wood` is 1, higher and lower."""
    crowns = _noise(stream, 1.1, 420)
    tone = np.clip(1.0 + 0.14 * _noise(f"{stream} tone", 1.6, 40) + 0.10 * crowns, 0.5, 1.6)
    canvas.rgb += wood[..., None] * (np.array(_WOOD, dtype=np.float32) * tone[..., None] - canvas.rgb)
    top = np.float32(height_m) * np.clip(1.0 + 0.22 * crowns + 0.15 * _noise(f"{stream} age", 1.6, 60), 0.3, 1.7)
    is_tree = wood * top > canvas.height_m
    canvas.built[is_tree], canvas.wooded[is_tree] = 0.0, wood[is_tree]
    canvas.height_m = np.maximum(canvas.height_m, wood * top)


def _house(canvas: Canvas, rng: np.random.Generator, area: Rectangle, roofs: tuple[Rgb, ...], height_m: float) -> None:
    """A gabled roof; its two halves slope away from the ridge."""
    x0, y0, x1, y1 = area
    if x1 <= x0 or y1 <= y0 or x0 < 0 or y0 < 0 or x1 > SIZE_PX or y1 > SIZE_PX:
        return
    canvas.fill(area, np.array(roofs[int(rng.integers(len(roofs)))]) * rng.uniform(0.85, 1.15), height_m)
    if x1 - x0 >= y1 - y0:
        canvas.height_m[(y0 + y1) // 2, x0:x1] += 1.5
    else:
        canvas.height_m[y0:y1, (x0 + x1) // 2] += 1.5


def _villages(canvas: Canvas, wood: Field, blocks: list[Rectangle], rng: np.random.Generator) -> None:
    """Houses with gardens along the roads from some corners of blocks."""
    roofs = _ROOFS[0] + _ROOFS[1]
    for index in rng.permutation(len(blocks))[: max(len(blocks) // 7, 1)]:
        x, y, *_ = blocks[int(index)]
        reach = int(rng.integers(12, 60))
        for is_column in (False, True):
            canvas.lamps_along((x, y), reach, is_column)
            for along in range(-reach // 3, reach, 4):
                for side in (-1, 1):
                    if rng.random() > 0.75:
                        continue
                    off = 3 * side - (1 if side < 0 else 0)
                    hx, hy = (x + off, y + along) if is_column else (x + along, y + off)
                    if not (12 < hx < SIZE_PX - 12 and 12 < hy < SIZE_PX - 12):
                        continue
                    garden = (hx - 3, hy - 3, hx + 5, hy + 5)
                    wood[garden[1] : garden[3], garden[0] : garden[2]] *= 0.2
                    if rng.random() < 0.5:
                        canvas.rgb[hy - 2 : hy + 4, hx - 2 : hx + 4] = np.array(_CROPS[2][1]) * rng.uniform(0.7, 1.0)
                    area = (hx, hy, hx + int(rng.integers(2, 5)), hy + int(rng.integers(2, 4)))
                    _house(canvas, rng, area, roofs, 6.0)
                    if rng.random() < 0.4:
                        wood[hy + 3 : hy + 5, hx - 2 : hx] = 1.0
    for _ in range(44):  # farms: barns and a house
        x, y = (int(value) for value in rng.integers(20, SIZE_PX - 30, 2))
        barn = (x, y, x + int(rng.integers(5, 12)), y + int(rng.integers(3, 6)))
        _house(canvas, rng, barn, (_RED_ROOF,) if rng.random() < 0.45 else _HALLS, 7.0)
        _house(canvas, rng, (x - 5, y + 1, x - 2, y + 4), roofs, 6.0)
        wood[y - 4 : y - 1, x - 6 : x + 3] = 1.0
        canvas.lamps_px.append((x + 2.0, y + 6.0))


def _paint_forest(canvas: Canvas, rng: np.random.Generator) -> None:
    stands = _bent(_blocks(rng, 40, 190), "stands", 12.0, 24)
    needles, leaves = _rgb(0.024, 0.034, 0.018), _rgb(0.044, 0.062, 0.024)
    mix = np.clip(0.5 + 0.3 * (stands - 0.5) / 0.29 + 0.3 * _noise("mix", 1.9, 18), 0, 1)[..., None]
    canvas.rgb[:] = needles + mix * (leaves - needles)
    crowns = _noise("canopy", 1.1, 400)
    canvas.rgb *= np.clip(1.0 + 0.09 * crowns + 0.12 * _noise("age", 1.7, 30), 0.5, 1.7)[..., None]
    canvas.height_m[:] = (11.0 + 9.0 * stands) * np.clip(1.0 + 0.2 * crowns, 0.4, 1.6)
    cleared = np.clip((_bent(_blocks(rng, 25, 90), "cleared", 4.0, 30) - 0.93) / 0.02, 0.0, 1.0)
    track = np.clip(1.6 - np.abs(smooth("forest track", 8)) / 0.009, 0.0, 1.0)
    glade = np.clip((_noise("glade", 2.2, 14) - 1.7) * 4.0, 0.0, 1.0)
    soil = _rgb(0.088, 0.088, 0.048) * (1.0 + 0.16 * _noise("clearing", 1.6, 50))[..., None]
    open_ = np.maximum(cleared, glade)[..., None]
    canvas.rgb += open_ * (soil - canvas.rgb)
    canvas.rgb += track[..., None] * (_rgb(0.125, 0.112, 0.085) - canvas.rgb)
    canvas.wooded[:] = (1.0 - open_[..., 0]) * (1.0 - track)
    canvas.height_m *= canvas.wooded


def _blocks(rng: np.random.Generator, smallest_px: float, largest_px: float) -> Field:
    """(2048, 2048) a random number in [0, 1) for each parcel."""
    values = np.zeros((SIZE_PX, SIZE_PX), dtype=np.float32)
    for (x0, y0, x1, y1), _ in _parcels(rng, smallest_px, largest_px):
        values[y0:y1, x0:x1] = rng.random()
    return values


def _paint_dry(canvas: Canvas, rng: np.random.Generator) -> None:
    sand, rock, pale = _rgb(0.250, 0.188, 0.128), _rgb(0.150, 0.110, 0.082), _rgb(0.33, 0.285, 0.225)
    stony = np.clip(0.5 + 0.45 * _noise("stony", 1.9, 9), 0, 1)
    canvas.rgb[:] = sand + stony[..., None] * (rock - sand)
    flats = np.clip(1.6 * (_noise("flats", 2.1, 8) - 1.3), 0, 1)[..., None]
    canvas.rgb += flats * (pale - canvas.rgb)
    lines = np.abs(0.9 * smooth("wadi", 7) + 0.22 * _noise("gully", 2.0, 26))
    bed = np.exp(-((lines / 0.05) ** 2))
    canvas.rgb *= (1.0 + 0.28 * bed)[..., None]
    banks = _noise("banks", 1.7, 40)
    # Gullies and hummocks, seen by their shading.
    canvas.height_m[:] = 9.0 * stony * np.clip(banks, -2.0, 2.0) + 20.0 - 7.0 * np.exp(-((lines / 0.12) ** 2))
    scrub = np.clip(0.6 * (_noise("scrub", 1.0, 300) - 1.3 + 0.9 * np.exp(-((lines / 0.12) ** 2))), 0, 1)[..., None]
    canvas.rgb += scrub * (_rgb(0.062, 0.066, 0.038) - canvas.rgb)
    canvas.rgb *= (1.0 + 0.06 * _noise("grit", 1.3, 120))[..., None]
    track = np.clip(1.6 - np.abs(smooth("dry track", 4)) / 0.006, 0.0, 1.0)[..., None]
    canvas.rgb += 0.7 * track * (pale - canvas.rgb)
    for _ in range(14):
        x, y = (int(value) for value in rng.integers(60, SIZE_PX - 60, 2))
        for _ in range(int(rng.integers(2, 12))):
            dx, dy = (int(value) for value in rng.integers(-16, 17, 2))
            size = rng.integers(2, 5, 2)
            area = (x + dx, y + dy, x + dx + int(size[0]), y + dy + int(size[1]))
            ground_m = float(canvas.height_m[y + dy, x + dx])
            canvas.fill(area, np.array((0.24, 0.205, 0.16)) * rng.uniform(0.7, 1.2), ground_m + 4.0)
            if rng.random() < 0.4:
                canvas.lamps_px.append((x + dx + 5.0, y + dy + 1.0))


def _paint_town(canvas: Canvas, rng: np.random.Generator) -> None:
    canvas.fill((0, 0, SIZE_PX, SIZE_PX), _ASPHALT)
    green = _rgb(0.060, 0.078, 0.036)
    density = _noise("density", 2.3, 7)
    district = _noise("district", 2.0, 9)
    wood = np.zeros((SIZE_PX, SIZE_PX), dtype=np.float32)
    for (x0, y0, x1, y1), depth in _parcels(rng, 34, 84):
        street = 4 if depth > 9 else 6
        block = (x0 + street, y0 + street, x1, y1)
        canvas.rank[y0:y1, x0:x1] = rng.random()
        canvas.lamps_along((x0, y0 + street // 2), x1 - x0, False)
        canvas.lamps_along((x0 + street // 2, y0), y1 - y0, True)
        if block[2] - block[0] < 6 or block[3] - block[1] < 6:
            continue
        middle = (y0 + y1) // 2, (x0 + x1) // 2
        dense, kind = float(density[middle]), rng.random()
        roofs = _ROOFS[int(np.clip(1.5 + 0.8 * district[middle], 0, 2))]
        if kind < 0.07:
            canvas.fill(block, green * rng.uniform(0.8, 1.2))
            wood[block[1] : block[3], block[0] : block[2]] = 0.55
        elif dense < -0.9 and kind < 0.75:
            _industry(canvas, rng, block)
        elif dense > 0.9:
            canvas.fill(block, (0.105, 0.102, 0.096))
            _rows(canvas, rng, block, (roofs, 15.0), (6, 11), 0)
        else:
            canvas.fill(block, green * rng.uniform(0.85, 1.15))
            wood[block[1] : block[3], block[0] : block[2]] = 0.34
            _rows(canvas, rng, block, (roofs, 7.0), (4, 6), int(rng.integers(1, 4)))
    trees = ((_noise("street trees", 1.0, 420) + 2.2 * wood) > 1.75) & (canvas.height_m < 1.0)
    _plant(canvas, cv2.GaussianBlur(trees.astype(np.float32), (0, 0), 0.7), "town crowns", 8.0)
    canvas.rgb *= (1.0 + 0.07 * _noise("wear", 1.4, 80))[..., None]


def _industry(canvas: Canvas, rng: np.random.Generator, block: Rectangle) -> None:
    """Halls with yards."""
    canvas.fill(block, np.full(3, rng.uniform(0.10, 0.16)))
    for area, _ in _parcels(rng, 18, 40, block):
        x0, y0, x1, y1 = area
        if rng.random() < 0.7 and min(x1 - x0, y1 - y0) > 8:
            color = _RED_ROOF if rng.random() < 0.04 else _HALLS[int(rng.integers(len(_HALLS)))]
            canvas.fill((x0 + 2, y0 + 2, x1 - 2, y1 - 2), np.array(color) * rng.uniform(0.85, 1.1), 9.0)


def _rows(
    canvas: Canvas,
    rng: np.random.Generator,
    block: Rectangle,
    roof: tuple[tuple[Rgb, ...], float],
    sizes_px: tuple[int, int],
    gap_px: int,
) -> None:
    """Houses along the four streets around a block, gardens or yards behind them."""
    x0, y0, x1, y1 = block
    setback = 1 if gap_px else 0
    color = tuple(np.array(roof[0][int(rng.integers(len(roof[0])))]) * rng.uniform(0.9, 1.1))
    family = (color, color, roof[0][0])
    for is_column in (False, True):
        low, high = (y0, y1) if is_column else (x0, x1)
        near, far = (x0, x1) if is_column else (y0, y1)
        for at_far in (False, True):
            along = low + setback + int(rng.integers(0, 3))
            while along < high - sizes_px[0]:
                wide = int(rng.integers(sizes_px[0], sizes_px[1] + 1))
                deep = min(int(rng.integers(sizes_px[0], sizes_px[1] + 1)), max((far - near) // 2 - 1, 3))
                start = far - setback - deep if at_far else near + setback
                end = min(along + wide, high - setback)
                area = (start, along, start + deep, end) if is_column else (along, start, end, start + deep)
                if rng.random() < 0.93:
                    _house(canvas, rng, area, family, roof[1] * rng.uniform(0.85, 1.2))
                along += wide + gap_px
