"""The `[camera]` section of a recipe: cameras as real ones are, from lens to coded picture, one a scene."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel


class CameraRanges(FrozenModel):
    """Distribution of cameras, drawn by scene; both eyes have the same.

    The rig's sensor and optics are the best camera of the distribution. Distortion is the rig's (`rig.eyes`), because
    it moves labels; shutters are global.

    Attributes:
        processed_scene_fraction: share of scenes with an image processor; the others have the sensor's own encoding.
        grey_scene_fraction: share of scenes with a grey camera.
        near_infrared_scene_fraction: share of scenes with a near-infrared camera, whose light is estimated from the
            three bands; with those of a grey one at most 1.
        full_well_fraction: full well and responsivity, in proportion to those of the rig's sensor; smaller pixels have
            more noise. Drawn uniformly in the logarithm.
        psf_sigma_px: point spread of the lens, with defocus. [px]
        vignetting_fraction: see `Optics.mechanical_falloff_fraction`.
        scattered_fraction: see `Optics.scattered_fraction`.
        lateral_color_px: largest shift of red and blue in the farthest corner, either way. [px]
        bloom_fraction: see `LensFlaws`.
        ghost_scene_fraction: share of scenes whose lens has ghosts of a sun in or near the view.
        window_scene_fraction: share of scenes behind a window with dirt, scratches, drops or reflections.
        white_balance_fraction: largest error of red and blue, either way.
        neutral_fraction: see `ImageProcessing`.
        exposure_ev: error of the exposure. [powers of 2]
        brightest_mean_fraction, contrast, black_fraction, saturation, denoise_sigma_px, kept_detail_fraction,
            denoise_threshold, sharpen, chroma_blur_px: see `ImageProcessing`.
        jpeg_scene_fraction: share of scenes coded as JPEG.
        jpeg_quality: quality that the encoder of JPEG is asked for.
        video_scene_fraction: share of scenes coded as intra pictures of H.264; with those of JPEG at most 1.
        video_quantizer: quantiser of H.264; larger is coarser.
        resampled_scene_fraction: share of scenes coded at a lower resolution.
        resolution_fraction: that resolution over the sensor's.
        interlaced_scene_fraction: share of scenes of which one field is shown.
        overlay_scene_fraction: share of scenes with lines or text over the picture.
    """

    processed_scene_fraction: Fraction = 0.9
    grey_scene_fraction: Fraction = 0.08
    near_infrared_scene_fraction: Fraction = 0.04
    full_well_fraction: Range = Range(low=0.2, high=1.0)
    psf_sigma_px: Range = Range(low=0.4, high=0.9)
    vignetting_fraction: Range = Range(low=0.0, high=0.35)
    scattered_fraction: Range = Range(low=0.005, high=0.05)
    lateral_color_px: float = Field(default=1.2, ge=0, le=10)
    bloom_fraction: Range = Range(low=0.005, high=0.05)
    ghost_scene_fraction: Fraction = 0.5
    window_scene_fraction: Fraction = 0.25
    white_balance_fraction: float = Field(default=0.06, ge=0, le=0.5)
    neutral_fraction: Range = Range(low=0.1, high=0.6)
    exposure_ev: Range = Range(low=-0.5, high=0.4)
    brightest_mean_fraction: Range = Range(low=0.2, high=0.4)
    contrast: Range = Range(low=-0.1, high=0.4)
    black_fraction: Range = Range(low=-0.02, high=0.04)
    saturation: Range = Range(low=0.7, high=1.35)
    denoise_sigma_px: Range = Range(low=0.7, high=1.5)
    kept_detail_fraction: Range = Range(low=0.05, high=0.6)
    denoise_threshold: Range = Range(low=1.5, high=5.0)
    sharpen: Range = Range(low=0.2, high=1.5)
    chroma_blur_px: Range = Range(low=1.0, high=4.0)
    jpeg_scene_fraction: Fraction = 0.45
    jpeg_quality: Range = Range(low=65, high=97)
    video_scene_fraction: Fraction = 0.35
    video_quantizer: Range = Range(low=18, high=32)
    resampled_scene_fraction: Fraction = 0.15
    resolution_fraction: Range = Range(low=0.45, high=0.9)
    interlaced_scene_fraction: Fraction = 0.06
    overlay_scene_fraction: Fraction = 0.12

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name, low, high in (
            ("full_well_fraction", 0.01, 1),
            ("psf_sigma_px", 0, 10),
            ("vignetting_fraction", 0, 0.99),
            ("scattered_fraction", 0, 0.5),
            ("bloom_fraction", 0, 0.5),
            ("neutral_fraction", 0, 1),
            ("exposure_ev", -3, 3),
            ("brightest_mean_fraction", 0.02, 1),
            ("contrast", -0.5, 1),
            ("black_fraction", -0.2, 0.2),
            ("saturation", 0, 3),
            ("denoise_sigma_px", 0.3, 4),
            ("kept_detail_fraction", 0, 1),
            ("denoise_threshold", 0.01, 30),
            ("sharpen", 0, 4),
            ("chroma_blur_px", 0, 10),
            ("jpeg_quality", 5, 100),
            ("video_quantizer", 0, 51),
            ("resolution_fraction", 0.2, 1),
        ):
            getattr(self, name).within(low, high, name)
        for one, other in (
            ("grey_scene_fraction", "near_infrared_scene_fraction"),
            ("jpeg_scene_fraction", "video_scene_fraction"),
        ):
            total = getattr(self, one) + getattr(self, other)
            # Shares such as 0.7 and 0.3 add up to a little more than 1.
            if total > 1 + 1e-9:
                raise ValueError(f"{one}, {other}: must add up to at most 1, got {total:g}")
        return self
