"""A small airfield around the place that a low camera flies over: runway, taxiway, apron and hangars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drogue_models.frozen_model import ReflectanceRgb
from scenes.ground.sea import inside_share
from scenes.ground_view import Field, GroundView

_CONCRETE: ReflectanceRgb = (0.20, 0.195, 0.18)
_ASPHALT: ReflectanceRgb = (0.085, 0.084, 0.083)
_PAINT = np.array([0.55, 0.55, 0.54], dtype=np.float32)
_WALLS: tuple[ReflectanceRgb, ...] = ((0.34, 0.34, 0.33), (0.20, 0.215, 0.24), (0.27, 0.245, 0.20), (0.14, 0.16, 0.14))
_MOWN_M, _DASH_M = 22.0, 50.0
_MOST_HALLS = 7
_LEVEL_M = 1300.0
_MARGIN_M, _FIELD_M, _OPEN_M = 80.0, 260.0, 260.0


@dataclass(frozen=True)
class _Rectangle:
    """Place on the ground along and across the runway, from its middle [m], height [m] and reflectance."""

    along_m: float
    across_m: float
    half_length_m: float
    half_width_m: float
    height_m: float
    rgb: ReflectanceRgb

    def holds(self, along_m: Field, across_m: Field, reach_m: Field | np.float32) -> NDArray[np.bool_]:
        """Whether places are inside, or outside by less than so much along or across. [m]"""
        along_m, across_m = np.abs(along_m - np.float32(self.along_m)), np.abs(across_m - np.float32(self.across_m))
        inside: NDArray[np.bool_] = (along_m - reach_m < self.half_length_m) & (across_m - reach_m < self.half_width_m)
        return inside


class Airfield:
    """Runway, taxiway, apron and halls of one scene.

    Args:
        rng: draws them.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        heading = float(rng.uniform(-0.3, 0.3))
        self._cosine, self._sine = np.float32(np.cos(heading)), np.float32(np.sin(heading))
        side = 1.0 if rng.random() < 0.5 else -1.0
        self._aside_m = side * float(rng.uniform(12.0, 45.0))
        half_m, self._half_width_m = float(rng.uniform(450.0, 900.0)), float(rng.choice([11.5, 15.0, 22.5]))
        self._middle_m = float(rng.uniform(150.0, 500.0))
        self._half_length_m = half_m
        surface = _ASPHALT if rng.random() < 0.7 else _CONCRETE
        self._paved = [
            _Rectangle(0.0, 0.0, half_m, self._half_width_m, 0.0, surface),
            _Rectangle(0.0, side * 95.0, half_m, 5.0, 0.0, _ASPHALT),
            _Rectangle(half_m * 0.2, side * 50.0, 5.0, 50.0, 0.0, _ASPHALT),
            _Rectangle(-half_m * 0.6, side * 50.0, 5.0, 50.0, 0.0, _ASPHALT),
            _Rectangle(0.0, side * 140.0, 170.0, 42.0, 0.0, _CONCRETE),
        ]
        self._halls = []
        at_m = -190.0
        for _ in range(int(rng.integers(3, _MOST_HALLS + 1))):
            length_m, deep_m = float(rng.uniform(9.0, 27.0)), float(rng.uniform(8.0, 18.0))
            at_m += length_m + float(rng.uniform(4.0, 30.0))
            color = _WALLS[int(rng.integers(len(_WALLS)))]
            height_m = float(rng.uniform(4.0, 11.0))
            self._halls.append(_Rectangle(at_m, side * (190.0 + deep_m), length_m, deep_m, height_m, color))
            at_m += length_m

    def height_m(self, trees_m: Field, x_m: Field, y_m: Field) -> Field:
        """(H, W) height of what stands there: halls, and outside of the field its (H, W) trees. [m]"""
        along, across = self._places(x_m, y_m)
        open_ = (np.abs(along) < self._half_length_m + _MARGIN_M) & (np.abs(across) < _FIELD_M)
        height = np.where(open_ | (np.hypot(x_m, y_m) < _OPEN_M), np.float32(0.0), trees_m)
        for hall in self._halls:
            height[hall.holds(along, across, np.float32(0.0))] = hall.height_m
        return height

    def has_hall(self, x_m: Field, y_m: Field, reach_m: Field) -> NDArray[np.bool_]:
        """(H, W) whether a hall is no farther along or across the field than so much. [m]"""
        along, across = self._places(x_m, y_m)
        has = np.zeros(along.shape, dtype=np.bool_)
        for hall in self._halls:
            has |= hall.holds(along, across, reach_m)
        return has

    def hill_share(self, x_m: Field, y_m: Field) -> Field:
        """(H, W) how much of their height hills keep: the field is level."""
        away_m = np.hypot(x_m, y_m)
        share: Field = np.clip((away_m - np.float32(_LEVEL_M)) / np.float32(_LEVEL_M), 0.0, 1.0)
        return share

    def drawn_on(self, albedo: Field, sunlit: Field, view: GroundView, detail: Field) -> tuple[Field, Field]:
        """Reflectance and sunlight with the airfield's mown grass, pavement, paint and halls over them."""
        along, across = self._places(view.x_m, view.y_m)
        if float(np.hypot(view.x_m, view.y_m).min()) > 2.0 * self._half_length_m + self._middle_m:
            return albedo, sunlit
        blur_m = self._blur_m(view)
        field = inside_share(along, self._half_length_m + _MARGIN_M, blur_m[0]) * inside_share(
            across, _FIELD_M, blur_m[1]
        )
        grass = np.array([0.075, 0.098, 0.042], dtype=np.float32)
        stripes = np.clip(4.0 * np.sin(across * np.float32(np.pi / _MOWN_M)), -1.0, 1.0)
        stripes = stripes * np.exp(-((blur_m[1] / np.float32(0.5 * _MOWN_M)) ** 2))
        texture = detail[..., None]
        mown = grass * (1.0 + np.float32(0.045) * stripes[..., None]) * texture
        albedo, sunlit = albedo + field[..., None] * (mown - albedo), sunlit + field * (1.0 - sunlit)
        for part in (*self._paved, *self._halls):
            share = inside_share(along - np.float32(part.along_m), part.half_length_m, blur_m[0])
            share = share * inside_share(across - np.float32(part.across_m), part.half_width_m, blur_m[1])
            color = np.array(part.rgb, dtype=np.float32) * (0.6 + 0.4 * texture)
            albedo = albedo + share[..., None] * (color - albedo)
        paint = self._paint(along, across, blur_m)[..., None]
        return albedo + paint * (_PAINT - albedo), sunlit

    def _paint(self, along: Field, across: Field, blur_m: tuple[Field, Field]) -> Field:
        """(H, W) share of white paint: centre line, edges, and bars at the ends of the runway."""
        on = inside_share(along, self._half_length_m - 30.0, blur_m[0])
        phase = np.mod(along, np.float32(_DASH_M)) - np.float32(_DASH_M / 2)
        sharp = np.exp(-((blur_m[0] / np.float32(0.5 * _DASH_M)) ** 2))
        dashes = sharp * inside_share(phase, 15.0, blur_m[0]) + (1.0 - sharp) * np.float32(30.0 / _DASH_M)
        paint = on * dashes * inside_share(across, 0.45, blur_m[1])
        for edge_m in (self._half_width_m - 1.0, 1.0 - self._half_width_m):
            paint = paint + on * inside_share(across - np.float32(edge_m), 0.45, blur_m[1])
        for end_m in (self._half_length_m - 25.0, 25.0 - self._half_length_m):
            bars = inside_share(along - np.float32(end_m), 15.0, blur_m[0])
            for index in np.arange(1.5, self._half_width_m / 1.8 - 1.0):
                both = inside_share(np.abs(across) - np.float32(1.8 * index), 0.9 if index % 2 else 0.0, blur_m[1])
                paint = paint + bars * both
        return np.asarray(np.minimum(paint, 0.9), dtype=np.float32)

    def _places(self, x_m: Field, y_m: Field) -> tuple[Field, Field]:
        along = self._cosine * x_m + self._sine * y_m - np.float32(self._middle_m)
        across = self._cosine * y_m - self._sine * x_m - np.float32(self._aside_m)
        return along, across

    def _blur_m(self, view: GroundView) -> tuple[Field, Field]:
        """(H, W) widths of the pieces of ground along the runway and across it. [m]"""
        along = np.abs(self._cosine * view.away_x + self._sine * view.away_y)
        across = np.abs(self._cosine * view.away_y - self._sine * view.away_x)
        return along * view.along_m + across * view.across_m, across * view.along_m + along * view.across_m
