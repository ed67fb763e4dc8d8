"""Painting an aircraft's atlas: colours of its scheme and their places, panels, markings, and what flight leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.procedural_maps import MapGrid, finished, fractal_noise, roundel
from drogue_models.tankers.airframe import Airframe, Roundel, Trail
from drogue_models.tankers.airframe_grids import Finish
from drogue_models.tankers.atlas import ATLAS_HEIGHT_PX, ATLAS_WIDTH_PX, Chart
from drogue_models.tankers.tanker import PaintScheme
from geometry.se3 import Array


@dataclass(frozen=True)
class Scheme:
    """Colours of a scheme, diffuse, linear Rec. 709.

    Attributes:
        above, below: the body's upper and lower colour.
        wing: of wings and tail planes; None for the body's.
        blotches: second colour of a two-tone camouflage, or None.
        wraps: whether the camouflage goes round the lower side too.
        cheat_line: of the line along the windows, or None.
        accent: of wing tips, fins and bands, or None.
        bare_edges: whether leading edges are bare metal.
        marked: whether it has roundels.
        toned_down: whether they are grey.
        windows: whether the cabin has windows.
        weave: whether it shows the weave of carbon fibre.
    """

    above: ReflectanceRgb
    below: ReflectanceRgb
    wing: ReflectanceRgb | None = None
    blotches: ReflectanceRgb | None = None
    wraps: bool = True
    cheat_line: ReflectanceRgb | None = None
    accent: ReflectanceRgb | None = None
    bare_edges: bool = False
    marked: bool = True
    toned_down: bool = True
    windows: bool = False
    weave: bool = False


# Greys are close to the FS 595 numbers named beside them; all other colours are our choice.
SCHEMES: dict[PaintScheme, Scheme] = {
    "light-grey": Scheme(above=(0.37, 0.385, 0.395), below=(0.37, 0.385, 0.395)),  # FS 36375
    "medium-grey": Scheme(above=(0.235, 0.255, 0.27), below=(0.26, 0.28, 0.295), bare_edges=True),  # FS 36173
    "white-cheat-line": Scheme(
        above=(0.74, 0.74, 0.73),
        below=(0.43, 0.44, 0.45),
        wing=(0.45, 0.46, 0.47),
        cheat_line=(0.02, 0.05, 0.20),
        bare_edges=True,
        toned_down=False,
        windows=True,
    ),
    "dark-grey": Scheme(above=(0.095, 0.10, 0.105), below=(0.125, 0.13, 0.135)),  # FS 36118
    "desert": Scheme(above=(0.40, 0.29, 0.17), below=(0.40, 0.30, 0.19), blotches=(0.19, 0.115, 0.065), wraps=True),
    "olive": Scheme(
        above=(0.085, 0.095, 0.05),
        below=(0.33, 0.35, 0.36),
        blotches=(0.055, 0.06, 0.065),
        wraps=False,
        toned_down=False,
    ),
    "navy": Scheme(above=(0.225, 0.25, 0.275), below=(0.40, 0.42, 0.43)),  # FS 36320 over FS 36375, faded
    "trainer": Scheme(above=(0.70, 0.70, 0.69), below=(0.68, 0.68, 0.67), accent=(0.60, 0.14, 0.02), toned_down=False),
    "carbon": Scheme(above=(0.032, 0.032, 0.034), below=(0.030, 0.030, 0.032), weave=True, marked=False),
}


Texels = NDArray[np.float32]

_WINGS = ("wing", "flap", "tailplane", "fin", "winglet", "wing-extension", "pylon")
_FINISH_RGB: dict[int, ReflectanceRgb] = {
    Finish.METAL: (0.30, 0.295, 0.285),
    Finish.DARK: (0.022, 0.021, 0.020),
    Finish.RUBBER: (0.03, 0.03, 0.03),
    Finish.PLASTIC: (0.075, 0.075, 0.078),
}
_GLASS: ReflectanceRgb = (0.020, 0.022, 0.026)
_SOOT: ReflectanceRgb = (0.030, 0.028, 0.026)
_OIL: ReflectanceRgb = (0.085, 0.062, 0.042)
_LINE_YELLOW: ReflectanceRgb = (0.55, 0.38, 0.04)
_WARNING_RED: ReflectanceRgb = (0.42, 0.03, 0.03)
_GAP_M = 0.012  # of panel and control surface gaps, with the dirt beside them
_EMBLEM_PX = 96
_SMALLEST_PX = 12  # of charts that show more than one colour
_SPREAD = 0.08  # of a trail's width over its length
_STREAM = 0x7A4B  # of the seeds of aircraft's paint


def paint_aircraft(airframe: Airframe, charts: Sequence[Chart], scheme: Scheme, seed: int) -> Texels:
    """(1024, 2048, 3) diffuse reflectance of an aircraft's atlas, linear Rec. 709."""
    atlas = np.full((ATLAS_HEIGHT_PX, ATLAS_WIDTH_PX, 3), 0.2, dtype=np.float32)
    for index, chart in enumerate(charts):
        atlas[chart.window] = finished(_Sheet(airframe, chart, scheme, seed, index).painted().astype(np.float64))
    return atlas


class _Sheet:
    """One chart while it is painted.

    Columns run along the surface: aft on bodies, towards the tip on wings, whose rows run from the trailing edge along
    the lower side to the nose and back along the upper side.
    """

    def __init__(self, airframe: Airframe, chart: Chart, scheme: Scheme, seed: int, index: int) -> None:
        self.airframe, self.chart, self.scheme, self.seed = airframe, chart, scheme, seed
        self.rng = np.random.default_rng([seed, index, _STREAM])
        self.role = chart.grid.role
        self.is_wing = self.role in _WINGS
        self.place_m = chart.points_m()
        self.size = (chart.height, chart.width)
        self.texel_m = chart.length_m / max(chart.width - 1, 1), chart.girth_m / max(chart.height - 1, 1)
        self.lower = (np.arange(chart.height) < chart.height / 2)[:, None]

    def painted(self) -> Texels:
        """(height, width, 3)."""
        if self.role == "canopy":
            return self._canopy()
        color = self._base()
        if min(self.size) >= _SMALLEST_PX:
            color *= self._panels()[..., None]
            self._equipment(color)
            for place in self.airframe.roundels:
                self._roundel(color, place)
            color *= self._mottle()[..., None]
        self._finishes(color)
        for trail in self.airframe.trails:
            self._trail(color, trail)
        if min(self.size) >= _SMALLEST_PX:
            self._grime(color)
        return color

    def _canopy(self) -> Texels:
        color = np.broadcast_to(_as_map(_GLASS), (*self.size, 3)).copy()
        x = self.place_m[..., 0]
        low, span = float(x.min()), float(np.ptp(x))
        for share in (0.36, 0.8):
            color[np.abs(x - low - share * span) < 0.05] = self.scheme.above
        color[self.place_m[..., 2] < float(self.place_m[..., 2].min()) + 0.18] = self.scheme.above
        return color

    def _base(self) -> Texels:
        scheme = self.scheme
        z = self.place_m[..., 2]
        above = np.broadcast_to(~self.lower, self.size) if self.is_wing and self.role != "fin" else z > self._side_z_m()
        if self.role == "fin":
            above = np.ones(self.size, dtype=bool)
        if self.role in ("pod", "nacelle", "fairing", "tank", "hose-unit", "fuselage-fairing"):
            above = np.zeros(self.size, dtype=bool) if scheme.wraps or self.role != "fuselage-fairing" else above
        first, second = scheme.above, scheme.below
        if scheme.wing is not None and self.role not in ("fuselage", "fin", "fin-cap"):
            first = second = scheme.wing
        color = np.where(above[..., None], _as_map(first), _as_map(second))
        if scheme.blotches is not None:
            size_m = 0.07 * float(np.ptp(self.place_m[..., 0])) if self.role == "fuselage" else 2.4
            size_m = min(max(size_m, 0.10), 3.5)
            field = self._noise((size_m, size_m), 2)
            where = (field > 0.12) & (above | scheme.wraps)
            color[where] = scheme.blotches
        if scheme.accent is not None:
            self._accents(color)
        if scheme.weave:
            row, column = np.indices(self.size)
            color *= (1.0 + 0.10 * (((row // 2 + column // 2) % 2) - 0.5))[..., None].astype(np.float32)
        return color.astype(np.float32)

    def _side_z_m(self) -> float:
        """Height of the edge between the upper and the lower colour."""
        if self.scheme.cheat_line is not None:
            return self.airframe.belt_z_m - 0.45
        return float(np.quantile(self.place_m[..., 2], 0.30))

    def _accents(self, color: Texels) -> None:
        """Bright bands where trainers and unmanned aircraft have them."""
        accent = self.scheme.accent
        assert accent is not None
        share = np.linspace(0.0, 1.0, self.size[1])
        if self.role in ("wing", "tailplane"):
            color[:, share > 0.80] = accent
        elif self.role == "fin":
            color[:, share > 0.62] = accent
        elif self.role in ("fuselage", "tank", "pod"):
            color[:, (share > 0.10) & (share < 0.17)] = accent
            color[:, (share > 0.70) & (share < 0.80)] = accent
        elif self.role in ("winglet", "arm"):
            color[:] = accent

    def _metres(self) -> tuple[float, float]:
        """Height and width of the sheet. [m]"""
        return self.chart.girth_m, self.chart.length_m

    def _panels(self) -> Texels:
        """Factor on the paint: panels of slightly different tone, dark gaps, and rows of rivets beside them."""
        girth_m, length_m = self._metres()
        panel_m = self.airframe.panel_m * (
            0.6 if self.role in ("pod", "nacelle", "pylon", "hose-unit", "tank") else 1.0
        )
        rows = _lines(self.rng, girth_m, 0.75 * panel_m)
        columns = _lines(self.rng, length_m, panel_m)
        row_of = np.searchsorted(rows, np.linspace(0.0, girth_m, self.size[0]))
        column_of = np.searchsorted(columns, np.linspace(0.0, length_m, self.size[1]))
        tone = 1.0 + 0.045 * self.rng.standard_normal((len(rows) + 1, len(columns) + 1)).clip(-2, 2)
        # Neighbouring panels are often one sheet.
        merged = self.rng.random(tone.shape) < 0.4
        tone[:, 1:][merged[:, 1:]] = tone[:, :-1][merged[:, 1:]]
        shade = tone.astype(np.float32)[row_of][:, column_of]
        kept_row = (self.rng.random((len(rows), len(columns) + 1)) < 0.72).astype(np.float32)
        kept_column = (self.rng.random((len(rows) + 1, len(columns))) < 0.85).astype(np.float32)
        depth_row, depth_column = (min(0.35, 0.55 * _GAP_M / size) for size in self.texel_m[::-1])
        for index, place in enumerate(rows):
            row = round(place / self.texel_m[1])
            self._groove(shade, row, kept_row[index][column_of], depth_row)
        for index, place in enumerate(columns):
            column = round(place / self.texel_m[0])
            self._groove(shade.T, column, kept_column[:, index][row_of], depth_column)
        return shade

    def _groove(self, shade: Texels, line: int, kept: Texels, depth: float) -> None:
        """A gap along one line of texels, and every other texel beside it darkened by a rivet."""
        if not 0 <= line < len(shade):
            return
        shade[line] *= 1.0 - depth * kept
        rivets = np.zeros_like(kept)
        rivets[::3] = 0.25 * depth
        for beside in (line - 2, line + 2):
            if 0 <= beside < len(shade):
                shade[beside] *= 1.0 - rivets * kept

    def _equipment(self, color: Texels) -> None:
        """Edges, hinges, windows, stripes and warnings that belong to a role."""
        x, _, z = (self.place_m[..., axis] for axis in range(3))
        if self.is_wing:
            self._wing_lines(color)
        elif self.role == "fuselage":
            self._fuselage_lines(color, x, z)
            self._belly_line(color, x, z)
        elif self.role == "fuselage-fairing":
            self._belly_line(color, x, z)
        elif self.role == "pod":
            share = np.linspace(0.0, 1.0, self.size[1])
            color[:, np.abs(share - 0.075) < 0.006] = _WARNING_RED
            color[:, (share > 0.66) & (share < 0.675)] *= 0.55

    def _wing_lines(self, color: Texels) -> None:
        x = self.place_m[..., 0]
        nose, chord = x.min(axis=0), np.maximum(np.ptp(x, axis=0), 1e-3)
        share = (x - nose) / chord
        if self.scheme.bare_edges and self.role in ("wing", "tailplane", "fin"):
            color[share < 0.055] = (0.40, 0.40, 0.40)
        for place, depth in ((0.13, 0.22), (0.62, 0.16), (0.735, 0.45)):
            if self.role in ("flap", "pylon"):
                continue
            near = np.abs(share - place) * chord < 0.6 * max(self.texel_m[1], _GAP_M)
            color[near] *= 1.0 - depth
        if self.role == "wing":
            # A walkway over the wing's root, between dark lines.
            y = np.abs(self.place_m[..., 1])
            root = float(y.min()) + 0.13 * float(np.ptp(y))
            line = 0.5 * max(self.texel_m[1], 0.05)
            walk = ~self.lower & (y < 2.2 * root)
            for place in (0.2, 0.58):
                color[walk & (np.abs(share - place) * chord < line)] = (0.03, 0.03, 0.03)

    def _fuselage_lines(self, color: Texels, x: Texels, z: Texels) -> None:
        scheme, frame = self.scheme, self.airframe
        if scheme.cheat_line is not None:
            color[np.abs(z - frame.belt_z_m + 0.05) < 0.24] = scheme.cheat_line
        if scheme.windows and frame.deck_m is not None:
            cabin = (
                (x > frame.deck_m[1] + 2.0) & (x < 0.8 * float(x.max())) & (np.abs(z - frame.belt_z_m - 0.05) < 0.16)
            )
            color[cabin & (np.mod(x, 0.53) < 0.24)] = _GLASS
        if frame.deck_m is not None:
            first_m, last_m, low_m = frame.deck_m
            glass = (
                (x > first_m)
                & (x < last_m)
                & (z > low_m + 0.28 * (x - first_m))
                & (z < low_m + 0.75 + 0.1 * (x - first_m))
            )
            frames = np.mod(self.place_m[..., 1] + 0.06, 0.72) < 0.12
            color[glass & ~frames] = _GLASS

    def _belly_line(self, color: Texels, x: Texels, z: Texels) -> None:
        """A line under a transport's belly, by which receivers keep to the middle."""
        if self.airframe.belly_line_m is None:
            return
        first_m, last_m = self.airframe.belly_line_m
        line = (np.abs(self.place_m[..., 1]) < 0.08) & (z < -0.5) & (x > first_m) & (x < last_m)
        color[line] = _as_map(_LINE_YELLOW) if self.scheme.windows else color[line] * np.float32(0.72)

    def _roundel(self, color: Texels, roundel_place: Roundel) -> None:
        if roundel_place.role != self.role or not self.scheme.marked:
            return
        radius_m, axis = roundel_place.radius_m, 3 - roundel_place.normal_axis
        second = self.place_m[..., axis]
        if axis == 1:
            second = np.abs(second)
        center = roundel_place.center_m
        offsets = self.place_m[..., 0] - np.float32(center[0]), second - np.float32(center[axis])
        on = np.hypot(*offsets) < radius_m
        if axis == 1:
            on &= self.lower == roundel_place.below
        if not on.any():
            return
        grid = MapGrid(2 * radius_m, 2 * radius_m, _EMBLEM_PX, _EMBLEM_PX)
        share, rgb = roundel(grid, self.seed, (radius_m, radius_m), radius_m, toned_down=self.scheme.toned_down)
        column, row = (
            np.clip((part[on] / radius_m + 1) / 2 * _EMBLEM_PX, 0, _EMBLEM_PX - 1).astype(int) for part in offsets
        )
        under = share[row, column, None].astype(np.float32)
        color[on] = color[on] * (1 - under) + rgb[row, column].astype(np.float32) * under

    def _mottle(self) -> Texels:
        """Fading and handling: broad and fine unevenness of the paint."""
        broad = self._noise((1.4 * self.airframe.panel_m,) * 2, 2)
        fine = self.rng.standard_normal(self.size, dtype=np.float32)
        streaks = self._streaks
        factor: Texels = 1.0 + np.float32(0.045) * broad + np.float32(0.012) * fine + np.float32(0.03) * streaks
        return factor

    @cached_property
    def _streaks(self) -> Texels:
        """Noise that is long along the flow: along the columns of bodies, along the rows of wings."""
        width_m = 0.07 * self.airframe.panel_m
        along_m = 14.0 * width_m
        return self._noise((along_m, width_m) if self.is_wing else (width_m, along_m), 1)

    def _noise(self, largest_m: tuple[float, float], octaves: int) -> Texels:
        """Noise of unit deviation with blotches of a size around and along the surface, on which it closes. [m]"""
        girth_m, length_m = self._metres()
        # The library's maps run around the surface along u.
        grid = MapGrid(girth_m, length_m, self.size[0], self.size[1], wraps=True)
        around_m = min(largest_m[0], girth_m / 2)
        noise = fractal_noise(grid, int(self.rng.integers(2**31)), (around_m, largest_m[1]), octaves)
        return np.ascontiguousarray(noise.T, dtype=np.float32)

    def _finishes(self, color: Texels) -> None:
        finish = self.chart.finish()
        for number, rgb in _FINISH_RGB.items():
            columns = finish == number
            if columns.any():
                grain = 1.0 + 0.06 * self.rng.standard_normal((self.size[0], int(columns.sum())))
                color[:, columns] = _as_map(rgb) * grain[..., None].astype(np.float32)

    def _trail(self, color: Texels, trail: Trail) -> None:
        if self.chart.grid.mirrored and trail.start_m[1] < 0:
            return
        window = self._reach(trail)
        if window is None:
            return
        place_m, start = self.place_m[window], np.array(trail.start_m, dtype=np.float32)
        behind = place_m[..., 0] - start[0]
        width = trail.width_m + _SPREAD * np.maximum(behind, 0.0)
        beside = (place_m[..., 1] - start[1]) / width
        above = (place_m[..., 2] - start[2]) / (2.2 * width)
        amount = np.exp(-(beside**2) - above**2 - np.maximum(behind, 0.0) / trail.length_m)
        amount *= trail.strength * np.clip(behind / (0.3 * trail.width_m + 0.05), 0.0, 1.0)
        if min(self.size) >= _SMALLEST_PX:
            amount *= np.clip(0.85 + 0.45 * self._streaks[window], 0.0, 1.3)
        _blend(color[window], amount, _OIL if trail.oil else _SOOT)

    def _reach(self, trail: Trail) -> tuple[slice, slice] | None:
        """Rows and columns that a trail may soil, or None."""
        reach_m = 3.0 * trail.length_m
        widest_m = 2.5 * (trail.width_m + _SPREAD * reach_m)
        start = np.array(trail.start_m)
        offset = np.concatenate([self.chart.grid.points_m, self.chart.grid.points_m[:, :1]], axis=1) - start
        near = (np.abs(offset[..., 1]) < widest_m) & (np.abs(offset[..., 2]) < 2.2 * widest_m)
        near &= (offset[..., 0] > -1.0) & (offset[..., 0] < reach_m)
        if not near.any():
            return None
        rows = _span(self.chart.around, near.any(axis=0), self.size[0])
        return rows, _span(self.chart.along, near.any(axis=1), self.size[1])

    def _grime(self, color: Texels) -> None:
        """Streaks of oil from drains and gaps on lower sides, and soil along the gaps."""
        if self.role in ("fin", "canopy", "blade", "lens") or self.scheme.weave:
            return
        drops = self._noise((1.1 * self.airframe.panel_m,) * 2, 1)
        lower = np.broadcast_to(self.lower, self.size) if self.is_wing else self.place_m[..., 2] < self._side_z_m()
        amount = np.clip(0.5 * drops + 0.6 * self._streaks - 0.75, 0.0, 1.0) * np.float32(0.55)
        _blend(color, np.where(lower, amount, 0.25 * amount), _OIL)


def _span(places: Array, near: NDArray[np.bool_], count: int) -> slice:
    """The texels between the outermost grid points that are near, and their neighbours."""
    found = np.flatnonzero(near)
    first, last = max(int(found[0]) - 1, 0), min(int(found[-1]) + 1, len(places) - 1)
    return slice(int(places[first] * (count - 1)), int(np.ceil(places[last] * (count - 1))) + 1)


def _as_map(rgb: ReflectanceRgb) -> Texels:
    return np.array(rgb, dtype=np.float32)


def _blend(color: Texels, amount: NDArray[np.floating[Any]], over: ReflectanceRgb) -> None:
    share = np.clip(amount, 0.0, 1.0).astype(np.float32)[..., None]
    color *= 1.0 - share
    color += share * _as_map(over)


def _lines(rng: np.random.Generator, length_m: float, step_m: float) -> NDArray[np.float64]:
    """Places of gaps along a length, unequally spaced."""
    count = max(1, round(length_m / step_m))
    steps = 1.0 + 0.35 * rng.uniform(-1.0, 1.0, count + 1)
    places: NDArray[np.float64] = np.cumsum(steps)[:-1] / steps.sum() * length_m
    return places
