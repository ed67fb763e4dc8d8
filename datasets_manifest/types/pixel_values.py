"""What the pixel values of a stereo pair mean, as a ROS bag carries it beside the images."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field, ValidationError

from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain

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
