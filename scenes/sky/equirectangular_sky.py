"""A user's equirectangular image as light: read, scaled, rotated, and its sun extracted."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.image_codecs import check_image_size, decode_exr
from datasets_manifest.types.environment import EnvironmentMap, read_environment_map
from geometry.bilinear_sampling import sample_bilinear
from scenes.sky.photometry import Radiance, luminance

_SMALLEST_PX = 16
_HDR_PIXEL_BYTES = 12
_LONGEST_HDR_HEADER = 65536  # our choice; a header has some hundred bytes
# Reach of the sun's glow in a photograph, and of the ring around it that replaces it. [rad]
_SPOT_RAD, _AROUND_RAD = np.radians(3.0), np.radians(8.0)
# A spot is the sun (or moon) if it is brighter than its surroundings by this factor, and if its illuminance of a facing
# plane is at least this share of the upper half's illuminance of level ground.
_CONTRAST, _SHARE = 12.0, 0.08


@dataclass(frozen=True, eq=False)
class EnvironmentMapLight:
    """Light from all directions by an environment map.

    Attributes:
        image: (H, 2H, 3) radiance without the sun; row 0 is the zenith, the middle column looks along the azimuth
            `rotation_rad`, and columns go clockwise as seen from above. [cd/m2]
        rotation_rad: from east towards north.
        sun_direction: (3,) unit vector in world axes; straight up without a sun.
        sun_lux: (3,) illuminance of a plane that faces the sun; zeros without a sun. [lux]
    """

    image: Radiance
    rotation_rad: float
    sun_direction: NDArray[np.float64]
    sun_lux: NDArray[np.float64]

    def radiance(self, directions: NDArray[np.floating]) -> Radiance:  # type: ignore[type-arg]
        """(H, W, 3) radiance along (H, W, 3) unit directions in world axes. [cd/m2]"""
        height, width = self.image.shape[:2]
        polar = np.arccos(np.clip(directions[..., 2], -1.0, 1.0))
        azimuth = np.arctan2(directions[..., 1], directions[..., 0])
        turns = (self.rotation_rad - azimuth) / (2 * np.pi) + 0.5
        column = np.mod(turns, 1.0) * width - 0.5
        row = np.clip(polar / np.pi * height - 0.5, 0, height - 1)
        # One more column on either side, because remap would wrap rows as well as columns.
        wide = np.concatenate([self.image[:, -1:], self.image, self.image[:, :1]], axis=1)
        places = (column + 1.0).astype(np.float32), row.astype(np.float32)
        return np.asarray(sample_bilinear(wide, *places), dtype=np.float32).reshape(directions.shape)

    def downsampled(self, height_px: int) -> EnvironmentMapLight:
        """The same light with a smaller image, averaged over its texels; itself if the image is not larger."""
        if self.image.shape[0] <= height_px:
            return self
        small = cv2.resize(self.image, (2 * height_px, height_px), interpolation=cv2.INTER_AREA)
        return EnvironmentMapLight(
            image=small, rotation_rad=self.rotation_rad, sun_direction=self.sun_direction, sun_lux=self.sun_lux
        )


@lru_cache(maxsize=4)
def _read_cached(sha256: str, suffix: str, file: Path, environment_map: EnvironmentMap) -> Radiance:
    data = read_environment_map(environment_map)
    image = _decode_hdr(data, file) if suffix == ".hdr" else _decode_exr(data, file)
    height, width = image.shape[:2]
    if width != 2 * height or height < _SMALLEST_PX:
        raise ValueError(
            f"environment.map: {file} must be twice as wide as high, and {_SMALLEST_PX} or more high; got {width} x "
            f"{height}"
        )
    if not np.isfinite(image).all():
        raise ValueError(f"environment.map: {file} holds infinite or undefined values; export it without them")
    if image.max() <= 0:
        raise ValueError(f"environment.map: {file} is black")
    # Resampling filters leave small negative values next to bright spots.
    return np.maximum(image, 0.0)


def load_map(environment_map: EnvironmentMap) -> EnvironmentMapLight:
    """The light of a map.

    Raises:
        ValueError: the file is missing, has changed, cannot be read, or is not twice as wide as high.
    """
    return _load_cached(environment_map, environment_map.folder)


@lru_cache(maxsize=4)
def _load_cached(environment_map: EnvironmentMap, folder: Path) -> EnvironmentMapLight:
    file = folder / environment_map.path
    still = environment_map.model_copy(update={"rotation_deg": 0.0})
    image = _read_cached(environment_map.sha256, file.suffix.lower(), file, still)
    scale = environment_map.cd_m2_per_unit
    if scale is None:
        assert environment_map.horizontal_illuminance_lux is not None
        given = _level_illuminance(image)
        if given <= 0:
            raise ValueError(f"environment.map: {file} is black above the horizon; give cd_m2_per_unit")
        scale = environment_map.horizontal_illuminance_lux / given
    image = image * np.float32(scale)
    rotation_rad = float(np.radians(environment_map.rotation_deg))
    without, direction, sun_lux = _extract_sun(image)
    turned = np.array([[np.cos(rotation_rad), -np.sin(rotation_rad)], [np.sin(rotation_rad), np.cos(rotation_rad)]])
    direction[:2] = turned @ direction[:2]
    return EnvironmentMapLight(image=without, rotation_rad=rotation_rad, sun_direction=direction, sun_lux=sun_lux)


def _decode_hdr(data: bytes, file: Path) -> Radiance:
    # The line of the size ends the header (G. Ward, Real Pixels, Graphics Gems II, 1991).
    size = re.search(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n", data[:_LONGEST_HDR_HEADER])
    if size is not None:
        try:
            check_image_size(int(size[1]), int(size[2]), _HDR_PIXEL_BYTES, len(data))
        except ValueError as error:
            raise ValueError(f"environment.map: {file} {error}") from error
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # an empty file, or absurd dimensions
        image = None
    if image is None or image.dtype != np.float32 or image.ndim != 3:
        raise ValueError("environment.map: the file cannot be read as Radiance HDR")
    return np.ascontiguousarray(image[..., 2::-1])


def _decode_exr(data: bytes, file: Path) -> Radiance:
    try:
        planes = {name: plane.astype(np.float32) for name, plane in decode_exr(data).items()}
    except ValueError as error:
        raise ValueError(f"environment.map: {file} cannot be read as EXR: {error}") from error
    names = "RGB" if all(name in planes for name in "RGB") else "YYY"
    if names[0] not in planes:
        raise ValueError(f"environment.map: {file} must hold the channels R, G, B, or Y; it holds {', '.join(planes)}")
    if any(planes[name].shape != planes[names[0]].shape for name in names):
        raise ValueError(f"environment.map: {file} must have channels of one size")
    return np.stack([planes[name] for name in names], axis=-1)


def _directions(height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(H, 2H, 3) unit vectors of the unrotated texels, and (H, 1) their solid angles. [sr]"""
    polar = (np.arange(height) + 0.5) * np.pi / height
    azimuth = -(np.arange(2 * height) + 0.5 - height) * np.pi / height
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    edges = np.cos(np.arange(height + 1) * np.pi / height)
    return (
        np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1),
        ((edges[:-1] - edges[1:]) * (np.pi / height))[:, None],
    )


def _level_illuminance(image: Radiance) -> float:
    """Illuminance of level ground by the upper half. [lux per unit]"""
    directions, solid_angle_sr = _directions(image.shape[0])
    return float((luminance(image) * solid_angle_sr * np.maximum(directions[..., 2], 0.0)).sum())


def _extract_sun(image: Radiance) -> tuple[Radiance, NDArray[np.float64], NDArray[np.float64]]:
    """The image without its sun, the sun's unrotated direction, and its illuminance of a facing plane.

    In a map of texels of a degree the sun would be blurred, and its shadows would be too soft.
    """
    directions, solid_angle_sr = _directions(image.shape[0])
    bright = luminance(image)
    row, column = np.unravel_index(int(bright.argmax()), bright.shape)
    cosine = directions @ directions[row, column]
    texel_rad = np.pi / image.shape[0]
    spot = cosine >= np.cos(max(_SPOT_RAD, 1.5 * texel_rad))
    around = (cosine >= np.cos(max(_AROUND_RAD, 4.5 * texel_rad))) & ~spot
    sky = np.median(image[around], axis=0)
    excess = np.maximum(image[spot] - sky, 0.0) * np.broadcast_to(solid_angle_sr, bright.shape)[spot][:, None]
    sun_lux = excess.sum(axis=0, dtype=np.float64)
    enough = float(luminance(sun_lux)) > _SHARE * _level_illuminance(image)
    if not enough or bright[row, column] < _CONTRAST * luminance(sky) or directions[row, column, 2] <= 0:
        return image, np.array([0.0, 0.0, 1.0]), np.zeros(3)
    direction = (directions[spot] * luminance(excess)[:, None]).sum(axis=0)
    without = image.copy()
    without[spot] = np.minimum(image[spot], sky)
    return without, direction / np.linalg.norm(direction), sun_lux
