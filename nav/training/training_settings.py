"""The settings of a training: network, images, duration, optimizer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain
from drogue_models.untrusted_files import parse_toml, read_text
from nav.detector.coarse_to_fine import LARGEST_SMALL_PX
from nav.detector.output_maps import MAX_SIDE_PX, SIZE_STEP_PX

SizePx = tuple[int, int]
"""(height, width) of the network's input. [px]"""

# They may differ when a training is resumed: they change its device or speed, the last bits of floats, or the exported
# file's metadata, but not what is trained.
_FREE_TO_CHANGE = (
    "device",
    "threads",
    "loader_workers",
    "checkpoint_minutes",
    "large_from_px",
    "small_below_px",
    "licence",
)


class TrainingSettings(FrozenModel):
    """The settings of a training.

    Attributes:
        variant, attention, fusion: of the network.
        views: `both` puts the two eyes of a pair into one batch, with the same geometric draw; `one` draws single eyes.
        mosaic: combine four images into one, but not in the last `plain_fraction` of the training.
        mosaic_fraction: of the images, in the steps with mosaic.
        photograph_fraction: of the images that are drawn at random, so many are photographs without a drogue where the
            training has any: of the other three in a mosaic, and of the images alone.
        pasted_fraction: of all images and photographs, so many get a drogue that is cut out of another pair.
        hard_fraction: of the samples of an epoch, whole images or the first of a mosaic, so many make way for pairs in
            which the weights that the training starts from fail (`nav.training.hard_pairs`).
        size_px: (height, width) of the network's input.
        final_size_px: the same in the last `final_fraction` of the training; None to keep `size_px`. A smaller one has
            the same shape.
        image_passes: number of images that pass forwards and backwards through the network in the whole training.
        batch_images: number of images in a step; even for `both` views.
        optimizer, learning_rate, weight_decay: of the optimizer; the learning rate is the peak of the schedule.
        warmup_fraction: of the training, in which the learning rate rises from zero; it then falls along a cosine to
            `floor_fraction` of its peak.
        ema_decay: per step, of the moving average of the weights, which is evaluated and exported.
        filter_sd: standard deviation of the filters before training; 0 for that of He et al. (arXiv:1502.01852, eq.
            10), which is 0.06 to 0.5 here, and slower to learn.
        fusion_start: weights with which ASFF begins: `random`, or the same at every location, which are `equal`, or
            `own` with most for the level that is fused into.
        prior_score: of every cell before training.
        cells_per_box: number of the best aligned cells that are assigned to a box.
        focus_power: exponent by which cells whose score is nearly right are weighted down; 0 is plain cross entropy.
        box_weight: of the loss of boxes beside that of scores.
        gradient_norm: longer gradients are clipped to this norm.
        seed: of all random draws.
        precision: `bf16` computes most operations in bfloat16; `auto` does so where the hardware supports it.
        device: `cpu` or `cuda`.
        threads: number of computing threads; 0 for all cores.
        loader_workers: number of workers that prepare images: 1 is a thread of the training, more are processes.
        checkpoint_minutes: longest time between two checkpoints; the end of every epoch is one too. [min]
        large_from_px: the exported detector takes boxes whose longer side in the input is at least this from a second
            pass at half the size; 0 for a single pass. [px]
        small_below_px: it looks again, at twice the scale, at boxes whose longer side is below this; 0 for never. [px]
        start_sha256: hash of the file of weights that the training starts from, set by `settings_from_start`; empty
            for random weights.
        licence: of the weights, stored in the exported files, such as an SPDX identifier; empty if not stated.
    """

    variant: Literal["l", "s"] = "l"
    attention: Literal["eca", "se"] = "eca"
    fusion: Literal["asff", "concat"] = "asff"
    views: Literal["one", "both"] = "both"
    mosaic: bool = True
    mosaic_fraction: float = Field(default=0.8, ge=0, le=1)
    plain_fraction: float = Field(default=0.15, ge=0, le=1)
    photograph_fraction: float = Field(default=0.2, ge=0, lt=1)
    pasted_fraction: float = Field(default=0.3, ge=0, le=1)
    hard_fraction: float = Field(default=0.0, ge=0, le=1, exclude_if=lambda share: not share)
    size_px: SizePx = (480, 640)
    final_size_px: SizePx | None = None
    final_fraction: float = Field(default=0.5, gt=0, lt=1)
    image_passes: int = Field(default=40_000, ge=1)
    batch_images: int = Field(default=8, ge=2, le=1024)
    optimizer: Literal["adamw", "muon", "sgd"] = "adamw"
    learning_rate: float = Field(default=2e-3, gt=0)
    weight_decay: float = Field(default=0.02, ge=0)
    warmup_fraction: float = Field(default=0.05, ge=0, le=0.5)
    floor_fraction: float = Field(default=0.01, ge=0, le=1)
    ema_decay: float = Field(default=0.998, ge=0, lt=1)
    filter_sd: float = Field(default=0.03, ge=0, le=1)
    fusion_start: Literal["random", "equal", "own"] = "random"
    prior_score: float = Field(default=0.01, gt=0, lt=1)
    cells_per_box: int = Field(default=10, ge=1, le=1000)
    focus_power: float = Field(default=1.0, ge=0, le=5)
    box_weight: float = Field(default=2.0, gt=0)
    gradient_norm: float = Field(default=10.0, gt=0)
    seed: int = Field(default=0, ge=0, lt=2**63)
    precision: Literal["auto", "float32", "bf16"] = "auto"
    device: Literal["cpu", "cuda"] = "cpu"
    threads: int = Field(default=0, ge=0, le=1024)
    loader_workers: int = Field(default=1, ge=1, le=64)
    checkpoint_minutes: float = Field(default=5.0, gt=0)
    large_from_px: float = Field(default=160.0, ge=0, le=MAX_SIDE_PX)
    small_below_px: float = Field(default=0.0, ge=0, le=LARGEST_SMALL_PX)
    start_sha256: str = Field(default="", pattern="^([0-9a-f]{64})?$", exclude_if=lambda digest: not digest)
    licence: str = Field(default="", max_length=100)

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        for name, size in (("size_px", self.size_px), ("final_size_px", self.final_size_px)):
            if size is not None and not all(side >= SIZE_STEP_PX and side % SIZE_STEP_PX == 0 for side in size):
                raise ValueError(
                    f"{name}: must be multiples of {SIZE_STEP_PX} px, such as 480x640, got {size_text(size)}"
                )
            if size is not None and max(size) > MAX_SIDE_PX:
                raise ValueError(f"{name}: must be at most {MAX_SIDE_PX} px a side, got {size_text(size)}")
        last = self.final_size_px or self.size_px
        # Images are cached at the larger size. Bars for its shape would stay in a smaller one of another shape, where
        # the exported network sees none.
        if self.largest_size_px != last and self.size_px[0] * last[1] != self.size_px[1] * last[0]:
            raise ValueError(
                f"final_size_px: must have the shape of the larger size_px {size_text(self.size_px)}, "
                f"got {size_text(last)}"
            )
        if self.views == "both" and self.batch_images % 2:
            raise ValueError(f"batch_images: must be even for both views at once, got {self.batch_images}")
        return self

    @property
    def largest_size_px(self) -> SizePx:
        """(height, width) at which images are cached."""
        sizes = (self.size_px, self.final_size_px or self.size_px)
        return max(sizes, key=lambda size: size[0] * size[1])

    @property
    def steps(self) -> int:
        """Number of optimizer steps."""
        return -(-self.image_passes // self.batch_images)

    def size_at(self, step: int) -> SizePx:
        """(height, width) of the network's input in a step, counted from 0."""
        if self.final_size_px is not None and step >= round(self.steps * (1 - self.final_fraction)):
            return self.final_size_px
        return self.size_px

    def mosaic_at(self, step: int) -> bool:
        """Whether a step combines images into mosaics."""
        return self.mosaic and step < round(self.steps * (1 - self.plain_fraction))


def size_text(size_px: SizePx) -> str:
    """`480x640` for a height of 480 and a width of 640."""
    return f"{size_px[0]}x{size_px[1]}"


def parse_size(text: str) -> SizePx:
    """(height, width) from a text such as `480x640`.

    Raises:
        ValueError: the text is not of that form.
    """
    height, cross, width = text.partition("x")
    if not cross or not (height.isdecimal() and width.isdecimal()) or len(text) > 12:
        raise ValueError(f"size: must be HEIGHTxWIDTH in pixels, such as 480x640, got {text!r}")
    return int(height), int(width)


def build_settings(
    file: Path | None, changes: Mapping[str, Any], network: Mapping[str, Any] | None = None
) -> TrainingSettings:
    """Settings from changes, a TOML file, a network's configuration and the defaults, in this order of precedence.

    Args:
        file: of the settings, or None.
        changes: values by the settings' names.
        network: variant, attention and fusion of the network that the training starts from.

    Raises:
        ValueError: no such file, not TOML, an unknown key or a wrong value; the message names the file.
    """
    table: dict[str, Any] = {}
    if file is not None:
        try:
            table = parse_toml(read_text(file))
        except OSError as error:
            raise ValueError(f"{file}: cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise ValueError(f"{file}: is not valid TOML: {error}") from error
        except ValueError as error:
            raise ValueError(f"{file}: is {error}") from error
    try:
        return TrainingSettings.model_validate({**(network or {}), **table, **changes})
    except ValidationError as error:
        where = f"{file}: " if file is not None else ""
        raise ValueError(f"{where}{explain(error)}") from error


def differing_settings(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """Keys in which two settings differ, except those that may change when a training is resumed; in order."""
    keys = [*first, *(key for key in second if key not in first)]
    missing = object()
    return [key for key in keys if key not in _FREE_TO_CHANGE and first.get(key, missing) != second.get(key, missing)]
