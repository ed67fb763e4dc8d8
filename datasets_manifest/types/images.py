"""The images that the cameras of the rig deliver, all that navigation sees of a scene, and what their values mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class StereoImages:
    """One stereo pair of images.

    Attributes:
        left: (H, W, 3) in the order red, green, blue, or (H, W) for a mono sensor.
        right: as `left`.
        left_mosaic: (H, W) raw RGGB mosaic of a Bayer sensor, else None.
        right_mosaic: as `left_mosaic`.
        bits: significant bits: 8 in uint8, 12 in uint16.
        encoding: `linear`, or `gamma` (the sRGB curve); a mosaic is always linear.
        black_level_dn: pixel value without light. [DN]
        time_s: mid-exposure. [s]
        exposure_s: exposure time. [s]
    """

    left: Pixels
    right: Pixels
    time_s: float
    exposure_s: float
    bits: Literal[8, 12] = 8
    encoding: Literal["linear", "gamma"] = "linear"
    black_level_dn: float = 0.0
    left_mosaic: Pixels | None = None
    right_mosaic: Pixels | None = None

    def __post_init__(self) -> None:
        dtype = np.uint8 if self.bits == 8 else np.uint16
        for name, image in (("left", self.left), ("right", self.right)):
            if image.dtype != dtype or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
                raise ValueError(
                    f"{name}: must be (H, W) or (H, W, 3) of {dtype.__name__}, got {image.shape} {image.dtype}"
                )
        if self.left.shape != self.right.shape:
            raise ValueError(f"right: must have the left image's shape {self.left.shape}, got {self.right.shape}")
        for name, mosaic in (("left_mosaic", self.left_mosaic), ("right_mosaic", self.right_mosaic)):
            if mosaic is not None and (mosaic.shape != self.left.shape[:2] or mosaic.dtype != dtype):
                raise ValueError(f"{name}: must be {self.left.shape[:2]} of {dtype.__name__}, got {mosaic.shape}")

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height). [px]"""
        return int(self.left.shape[1]), int(self.left.shape[0])


def srgb_from_light(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level on the sRGB curve (IEC 61966-2-1) of linear light, both in [0, 1]."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055)


def light_from_srgb(level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light of a level on the sRGB curve (IEC 61966-2-1), both in [0, 1]."""
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def display_table(
    encoding: Literal["linear", "gamma"], bits: int, black_level_dn: float, display_bits: Literal[8, 16] = 8
) -> Pixels:
    """(2^bits,) pixel value for a screen, on the sRGB curve and 0 at the black level, by pixel value."""
    codes, black = np.arange(2**bits) / (2**bits - 1), np.array(black_level_dn / (2**bits - 1))
    if encoding == "gamma":
        codes, black = light_from_srgb(codes), light_from_srgb(black)
    light = np.clip((codes - black) / (1 - black), 0, 1)
    levels = np.round((2**display_bits - 1) * srgb_from_light(light))
    table: Pixels = levels.astype(np.uint8 if display_bits == 8 else np.uint16)
    return table


PIXEL_VALUES_TOPIC: Final = "/stereo/pixel_values"
"""Topic of `std_msgs/msg/String` messages with the text of `PixelValues`, one a pair."""


class PixelValues(FrozenModel):
    """Meaning of the pixel values of both images of a pair.

    Attributes:
        stamp_ns: time stamp of the pair's images. [ns]
        encoding: `linear`, or `gamma` (the sRGB curve); a raw mosaic is always linear.
        black_level_dn: pixel value without light. [DN]
        bits: significant bits.
        exposure_s: exposure time; 0 where it is unknown. [s]
    """

    stamp_ns: int = Field(ge=0)
    encoding: Literal["linear", "gamma"]
    black_level_dn: float = Field(ge=0, le=65535)
    bits: int = Field(ge=8, le=16)
    exposure_s: float = Field(ge=0, le=10)

    def as_text(self) -> str:
        """The JSON text of the message."""
        return self.model_dump_json()


def parse_pixel_values(text: str) -> PixelValues:
    """Read what `PixelValues.as_text` wrote.

    Raises:
        ValueError: the text is not that.
    """
    try:
        return PixelValues.model_validate_json(text)
    except ValidationError as error:
        raise ValueError(explain(error)) from error
