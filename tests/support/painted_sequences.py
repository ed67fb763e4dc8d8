"""Sequences painted from the drogue's measures, without the project's renderers, its projection or its detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import cv2
import numpy as np

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES

WIDTH, HEIGHT = 640, 480
RATE_HZ = 25.0
# Shares of the rim's radius in the shipped drogue: ring of markers 0.27 m, marker 0.05 m, mouth of the face, hub.
RING, MARKER, MOUTH, HUB_OUTER, HUB_INNER = 0.27 / 0.33, 0.05 / 0.33, 0.65, 0.23, 0.15
# Disparity in box widths: a baseline of 0.12 m beside a rim of 0.66 m.
DISPARITY = 0.12 / 0.66
FACE_RGB, RED_RGB, SKY_RGB = (8.0, 8.0, 9.0), (150.0, 10.0, 10.0), (110.0, 140.0, 185.0)


@dataclass(frozen=True)
class Look:
    """What differs from sequence to sequence.

    Attributes:
        ground: fields of two colours in place of an even sky.
        is_mono: one channel.
        bits: 8 or 12.
        light: factor on all light.
        noise_dn: standard deviation of noise. [DN of 8 bits]
    """

    ground: bool = False
    is_mono: bool = False
    bits: int = 8
    light: float = 1.0
    noise_dn: float = 1.0


@dataclass(frozen=True)
class Place:
    """Where the left eye sees the rim: middle and diameter; `hidden` for a pair in which something hides it all."""

    x: float
    y: float
    size: float
    hidden: bool = False

    def box(self, eye: str) -> tuple[float, float, float, float]:
        """x, y, width, height. [px]"""
        x = self.x - (DISPARITY * self.size if eye == "right" else 0)
        return x - self.size / 2, self.y - self.size / 2, self.size, self.size


@cache
def noise() -> np.ndarray:
    """(H, W, 3) of unit variance, drawn once: pairs take it from different places, which is much quicker."""
    return np.random.default_rng(5).standard_normal((HEIGHT, WIDTH, 3), dtype=np.float32)


def background(look: Look, shift: float) -> np.ndarray:
    """(H, W, 3) light beyond the drogue."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    if not look.ground:
        return np.asarray(SKY_RGB, np.float32) * (0.85 + 0.3 * v / HEIGHT)[..., None]
    fields = (np.floor((u + shift) / 47) + np.floor((v + 0.7 * shift) / 31)) % 2
    return np.where(fields[..., None] == 0, np.float32([95, 75, 55]), np.float32([40, 62, 28]))


def paint(place: Place, eye: str, look: Look, turn: int) -> np.ndarray:
    """One eye's picture."""
    image = np.ascontiguousarray(background(look, 3 * place.x), dtype=np.float32)
    x, y, width, _ = place.box(eye)
    middle, radius = np.array([x + width / 2, y + width / 2]), width / 2
    if not place.hidden:
        sky = image.copy()
        disc(image, middle, radius, FACE_RGB)
        disc(image, middle, MOUTH * radius, sky)
        disc(image, middle, HUB_OUTER * radius, RED_RGB)
        disc(image, middle, HUB_INNER * radius, FACE_RGB)
        for angle in (np.arange(8) + 0.3) * np.pi / 4:
            disc(image, middle + RING * radius * np.array([np.cos(angle), np.sin(angle)]), MARKER * radius, RED_RGB)
    image = image * look.light + look.noise_dn * np.roll(noise(), turn, axis=(0, 1))
    if look.is_mono:
        image = image @ np.float32([0.3, 0.5, 0.2])
    scale = 1 if look.bits == 8 else 16
    return np.clip(np.round(image * scale), 0, 2**look.bits - 1).astype(np.uint8 if look.bits == 8 else np.uint16)


def disc(image: np.ndarray, middle: np.ndarray, radius: float, value: Sequence[float] | np.ndarray) -> None:
    """Fill a disc with a colour, or with another picture; pixels on its edge get the share that a straight edge has."""
    low = np.maximum(np.floor(middle - radius - 1), 0).astype(int)
    high = np.minimum(np.ceil(middle + radius + 2), (WIDTH, HEIGHT)).astype(int)
    if (high <= low).any():
        return
    x, y = (np.arange(low[axis], high[axis], dtype=np.float32) - np.float32(middle[axis]) for axis in (0, 1))
    share = np.clip(radius + 0.5 - np.hypot(x[None, :], y[:, None]), 0, 1)
    part = image[low[1] : high[1], low[0] : high[0]]
    filling = np.asarray(value, np.float32)
    filling = filling if filling.ndim == 1 else filling[low[1] : high[1], low[0] : high[0]]
    part += (filling - part) * share[..., None]


def overlap(found: tuple[float, ...], true: tuple[float, ...]) -> float:
    """Intersection over union, by OpenCV's rotated rectangles."""
    rectangles = [((x + w / 2, y + h / 2), (w, h), 0.0) for x, y, w, h in (found, true)]
    kind, points = cv2.rotatedRectangleIntersection(*rectangles)
    shared = 0.0 if kind == cv2.INTERSECT_NONE or points is None else float(cv2.contourArea(cv2.convexHull(points)))
    return shared / (found[2] * found[3] + true[2] * true[3] - shared)


def swing(size: float, frames: int) -> list[Place]:
    """To and fro by up to 60 px from pair to pair."""
    angle = 0.3 * np.arange(frames)
    return [Place(320 + 200 * np.sin(a), 240 + 70 * np.sin(1.7 * a), size) for a in angle]


def growing(first: float, last: float, frames: int) -> list[Place]:
    """An approach."""
    share = np.arange(frames) / (frames - 1)
    return [Place(370 + 12 * np.sin(20 * s), 240 + 9 * np.cos(17 * s), first * (last / first) ** s) for s in share]


def film(places: Sequence[Place], look: Look = Look(), start_s: float = 0.0) -> list[StereoImages]:
    """Pairs at 25 Hz."""
    return list(_film(tuple(places), look, start_s))


@lru_cache(maxsize=2)
def _film(places: tuple[Place, ...], look: Look, start_s: float) -> list[StereoImages]:
    pairs = []
    for index, place in enumerate(places):
        left, right = (paint(place, eye, look, 37 * index + 17 * number) for number, eye in enumerate(EYES))
        pairs.append(StereoImages(left, right, start_s + index / RATE_HZ, 1e-3, 8 if look.bits == 8 else 12))
    return pairs
