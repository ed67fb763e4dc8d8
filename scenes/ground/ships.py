"""Ships at sea, some of them red: what a search for red discs must not fall for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drogue_models.parameters import ReflectanceRgb
from scenes.ground.sea import GroundLight
from scenes.ground_view import GroundView
from scenes.mip_tile import Field
from scenes.sky.light import Radiance

_HULLS: tuple[ReflectanceRgb, ...] = ((0.38, 0.05, 0.04), (0.22, 0.05, 0.035), (0.05, 0.07, 0.12), (0.10, 0.10, 0.10))
_HOUSE: ReflectanceRgb = (0.55, 0.55, 0.53)
_WAKE_REFLECTANCE = 0.22
_WAKE_LENGTHS = 7.0
_MOST_SHIPS = 4


@dataclass(frozen=True)
class Ship:
    """A ship from above: a hull with its bridge aft, and a wake.

    Attributes:
        x_m, y_m: of its middle, east and north of the place about which the sea is laid out. [m]
        heading_rad: from east towards north.
        length_m, width_m: [m]
        hull_rgb: diffuse reflectance of hull and deck.
    """

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    width_m: float
    hull_rgb: ReflectanceRgb


def sample_ships(rng: np.random.Generator, altitude_m: float) -> tuple[Ship, ...]:
    """Ships ahead of the camera, often none."""
    ships = []
    for _ in range(int(rng.integers(0, _MOST_SHIPS + 1))):
        away_m = altitude_m * rng.uniform(3.5, 12.0)
        length_m = rng.uniform(60, 330)
        ships.append(
            Ship(
                x_m=float(away_m),
                y_m=float(away_m * rng.uniform(-0.35, 0.35)),
                heading_rad=float(rng.uniform(-np.pi, np.pi)),
                length_m=float(length_m),
                width_m=float(length_m / rng.uniform(5.5, 7.5)),
                hull_rgb=_HULLS[int(rng.integers(len(_HULLS)))],
            )
        )
    return tuple(ships)


def put_ships(water: Radiance, view: GroundView, ships: tuple[Ship, ...], light: GroundLight) -> None:
    """Draw ships and their wakes into the radiance of the sea, in place."""
    level = (light.level_lux / np.pi).astype(np.float32)
    for ship in ships:
        reach_m = ship.length_m * (_WAKE_LENGTHS + 1)
        far_m, near_m = float(view.along_m.max()), float(view.x_m.min())
        if not near_m - reach_m - far_m < ship.x_m < float(view.x_m.max()) + reach_m + far_m:
            continue
        cosine, sine = np.float32(np.cos(ship.heading_rad)), np.float32(np.sin(ship.heading_rad))
        dx, dy = view.x_m - np.float32(ship.x_m), view.y_m - np.float32(ship.y_m)
        ahead, beside = cosine * dx + sine * dy, cosine * dy - sine * dx
        blur = _widths(view, cosine, sine)
        tail = np.clip(-ahead / np.float32(ship.length_m * _WAKE_LENGTHS), 0.0, 1.0)
        half_m = ship.width_m * (0.35 + 1.6 * tail)
        wake = _inside(beside, half_m, blur[1]) * (1.0 - tail) * (ahead < 0)
        water += (0.8 * wake)[..., None] * (np.float32(_WAKE_REFLECTANCE) * level - water)
        hull = _inside(ahead, ship.length_m / 2, blur[0]) * _inside(beside, ship.width_m / 2, blur[1])
        water += hull[..., None] * (np.array(ship.hull_rgb, dtype=np.float32) * level - water)
        aft = _inside(ahead + np.float32(0.38 * ship.length_m), 0.06 * ship.length_m, blur[0])
        house = aft * _inside(beside, 0.45 * ship.width_m, blur[1])
        water += house[..., None] * (np.array(_HOUSE, dtype=np.float32) * level - water)


def _widths(view: GroundView, cosine: np.float32, sine: np.float32) -> tuple[Field, Field]:
    """(H, W) widths of the pieces along the ship and across it. [m]"""
    along = np.abs(cosine * view.away_x + sine * view.away_y)
    across = np.abs(cosine * view.away_y - sine * view.away_x)
    return along * view.along_m + across * view.across_m, across * view.along_m + along * view.across_m


def _inside(place_m: Field, half_m: Field | float, blur_m: Field) -> Field:
    """(H, W) share of each piece that lies within a distance of a line."""
    low = np.maximum(place_m - blur_m / 2, -half_m)
    high = np.minimum(place_m + blur_m / 2, half_m)
    result: Field = (np.clip(high - low, 0.0, None) / blur_m).astype(np.float32)
    return result
