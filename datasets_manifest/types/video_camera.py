"""What a camera does besides its ideal sensor: lens flaws, a window before it, image processing, coding and overlays.

Nothing here moves the image: pixel (u, v) shows the ray that the rig says. So labels stay those of the rig.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from datasets_manifest.types.field_types import Fraction
from drogue_models.frozen_model import FrozenModel

Spectrum = Literal["colour", "grey", "near-infrared"]
# Of drawn cameras for the near infrared, as of the rig behind a filter. [nm]
CAMERA_BAND_NM = 850.0


class LensFlaws(FrozenModel):
    """Flaws of a lens beyond those of `Optics`.

    Attributes:
        lateral_red_px, lateral_blue_px: how much farther from the principal point the farthest corner appears in red
            and blue than in green, which stays in place. [px]
        bloom_fraction: share of the light of every point that the glass spreads over its surroundings.
        ghost_fraction: share of the sun's or moon's light on the lens that returns as ghosts.
        ghost_seed: decides where on the line through the principal point the ghosts lie.
    """

    lateral_red_px: float = Field(default=0.0, ge=-10, le=10)
    lateral_blue_px: float = Field(default=0.0, ge=-10, le=10)
    bloom_fraction: float = Field(default=0.0, ge=0, le=0.5)
    ghost_fraction: float = Field(default=0.0, ge=0, le=0.01)
    ghost_seed: int = Field(default=0, ge=0)


class Window(FrozenModel):
    """A window or visor close to the lens and far out of focus.

    Attributes:
        seed: decides where its marks are; each eye looks through another part of it.
        dirt_fraction: largest share of light that a spot of dirt takes.
        scratches, drops: how many, in the view of an eye.
        reflection_fraction: largest luminance of what it reflects, over the sum of two: the mean of the view without
            the sun's disc, and a white diffuser in the sun.
    """

    seed: int = Field(ge=0)
    dirt_fraction: float = Field(default=0.0, ge=0, le=0.8)
    scratches: int = Field(default=0, ge=0, le=200)
    drops: int = Field(default=0, ge=0, le=200)
    reflection_fraction: float = Field(default=0.0, ge=0, le=1)


class ImageProcessing(FrozenModel):
    """From raw values to the picture: mosaic, interpolation, white balance, tones, denoising, sharpening.

    Attributes:
        demosaic: how the mosaic is interpolated.
        white_balance: (red, blue) wrong factors on the channels.
        neutral_fraction: how far the camera takes the mean colour of the view to grey: 0 not at all, 1 completely, on a
            logarithmic scale.
        exposure_factor: on the signal before the tone curve, whose slope at black it is; white stays white.
        brightest_mean_fraction: linear level that the mean of both eyes' pictures may reach; a brighter view gets a
            smaller exposure factor.
        contrast: of the S-shaped part of the tone curve; 0 is the sRGB curve alone, negative is flat.
        black_fraction: level of black in the picture; negative crushes shadows.
        saturation: factor on chroma; above 1 strong colours gain less.
        denoise_sigma_px: blur of the smoothed picture that fine detail is taken from. [px]
        kept_detail_fraction: share of faint detail, and noise, that denoising leaves.
        denoise_threshold: detail is faint below so many standard deviations of the noise at its level.
        sharpen: how much distinct detail is amplified.
        chroma_blur_px: standard deviation of the blur of chroma. [px]
    """

    demosaic: Literal["bilinear", "edge-aware"] = "edge-aware"
    white_balance: tuple[float, float] = (1.0, 1.0)
    neutral_fraction: Fraction = 0.0
    exposure_factor: float = Field(default=1.0, gt=0.05, le=20)
    brightest_mean_fraction: float = Field(default=1.0, gt=0.01, le=1)
    contrast: float = Field(default=0.0, ge=-0.5, le=1)
    black_fraction: float = Field(default=0.0, ge=-0.2, le=0.2)
    saturation: float = Field(default=1.0, ge=0, le=3)
    denoise_sigma_px: float = Field(default=1.0, ge=0.3, le=4)
    kept_detail_fraction: Fraction = 1.0
    denoise_threshold: float = Field(default=3.0, gt=0, le=30)
    sharpen: float = Field(default=0.0, ge=0, le=4)
    chroma_blur_px: float = Field(default=1.0, ge=0, le=10)


class ImageCoding(FrozenModel):
    """How the picture is sent and stored; the stored pair is what a viewer decodes.

    Attributes:
        resolution_fraction: it is coded at this size and scaled up again, corner to corner.
        is_interlaced: every other row is interpolated between its neighbours, as from one field.
        codec: of the transform.
        quality: of JPEG.
        quantizer: H.264's quantisation parameter.
    """

    resolution_fraction: float = Field(default=1.0, ge=0.2, le=1)
    is_interlaced: bool = False
    codec: Literal["none", "jpeg", "h264-intra"] = "none"
    quality: int = Field(default=90, ge=5, le=100)
    quantizer: int = Field(default=28, ge=0, le=51)


class Overlay(FrozenModel):
    """Lines and text over the picture, as a recorder or a cockpit display draws them; no part in labels.

    Attributes:
        is_timecoded: a time and a frame number in the corner.
        is_at_top: whether the text is in the top corner, else at the bottom.
        has_crosshair: thin lines about the centre.
        has_frame: a thin line along the edges.
        level: of lines and text; 1 is white.
        opacity: of lines and text.
    """

    is_timecoded: bool = False
    is_at_top: bool = False
    has_crosshair: bool = False
    has_frame: bool = False
    level: Fraction = 1.0
    opacity: Fraction = 0.8


class VideoCamera(FrozenModel):
    """A scene's camera, which both eyes share; their noise differs.

    Attributes:
        spectrum: light that it sees. Grey and near infrared are monochrome; the infrared is estimated from the three
            bands, as nothing is known beyond them.
        lens: flaws.
        window: before the lens, or none.
        processing: of the raw values; None for the sensor's own interpolation and encoding.
        coding: of the pictures.
        overlay: on the pictures, or none.
    """

    spectrum: Spectrum = "colour"
    lens: LensFlaws = LensFlaws()
    window: Window | None = None
    processing: ImageProcessing | None = None
    coding: ImageCoding = ImageCoding()
    overlay: Overlay | None = None
