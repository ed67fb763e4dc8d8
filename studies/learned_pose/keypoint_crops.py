"""Square crops about a drogue's box, the input of the keypoint networks, and their augmentation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.records import PixelBox
from geometry.se3 import Array

CROP_PX = 256
"""Side of a network's input."""
PATCH_PX = 384
"""Side of the stored neighbourhood of a drogue, from which crops are taken."""
_PATCH_SIDE = 2.0  # side of a patch in sides of the box; holds every augmented crop's drogue
_CROP_SIDE = 1.35  # side of a crop in sides of the box, without augmentation
_PADDING_DN = 114
# Errors of a good detector's box: of its middle and of its size, in sides of the box.
_BOX_SHIFT, _BOX_SCALE = 0.03, 0.05


@dataclass(frozen=True, eq=False)
class Patch:
    """The neighbourhood of a drogue.

    Attributes:
        pixels: (PATCH_PX, PATCH_PX, 3).
        image_from_patch: (2, 3) affine map between pixel-centre coordinates.
    """

    pixels: NDArray[np.uint8]
    image_from_patch: Array


@dataclass(frozen=True)
class CropView:
    """How a crop is taken from a patch; the defaults are those without augmentation.

    Attributes:
        side: of the crop, in sides of the box.
        shift: of the crop's middle to the right and down, in sides of the box.
        turn_rad: by which the drogue is turned clockwise in the crop.
        mirrored: left and right exchanged, before the turn.
        gain, offset_dn: of the brightness.
        blur_px: standard deviation of a Gaussian blur. [px of the crop]
        noise_dn: standard deviation of added noise.
    """

    side: float = _CROP_SIDE
    shift: tuple[float, float] = (0.0, 0.0)
    turn_rad: float = 0.0
    mirrored: bool = False
    gain: float = 1.0
    offset_dn: float = 0.0
    blur_px: float = 0.0
    noise_dn: float = 0.0


def sample_box(rng: np.random.Generator, box_xywh_px: PixelBox) -> PixelBox:
    """The box that a detector would give instead of the true one."""
    x, y, width, height = box_xywh_px
    side = max(width, height)
    right, down = rng.uniform(-_BOX_SHIFT, _BOX_SHIFT, 2).tolist()
    wider, higher = rng.uniform(1 - _BOX_SCALE, 1 + _BOX_SCALE, 2).tolist()
    middle_x, middle_y = x + width / 2 + right * side, y + height / 2 + down * side
    return (middle_x - wider * width / 2, middle_y - higher * height / 2, wider * width, higher * height)


def cut_patch(image: NDArray[np.uint8], box_xywh_px: PixelBox) -> Patch:
    """The square about a box, at the size of a patch, grey where it reaches over the image's edge.

    Args:
        image: (H, W, 3).
        box_xywh_px: in pixel-centre coordinates.
    """
    x, y, width, height = box_xywh_px
    side = max(8, round(_PATCH_SIDE * max(width, height)))
    left, top = (round(low + extent / 2 + 0.5 - side / 2) for low, extent in ((x, width), (y, height)))
    region = np.full((side, side, 3), _PADDING_DN, np.uint8)
    rows = slice(max(0, top), min(image.shape[0], top + side))
    columns = slice(max(0, left), min(image.shape[1], left + side))
    inside = image[rows, columns]
    if inside.size:
        region[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = inside
    smaller = side > PATCH_PX
    pixels = cv2.resize(region, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
    scale = side / PATCH_PX
    # Corners of pixels map onto corners: x + 0.5 = left + scale (u + 0.5).
    offset = (scale - 1) / 2
    return Patch(np.asarray(pixels), np.array([[scale, 0.0, left + offset], [0.0, scale, top + offset]]))


def sample_view(rng: np.random.Generator) -> CropView:
    """An augmented crop: moved, scaled, turned, mirrored, brighter or darker, blurred, noisy."""
    return CropView(
        side=float(rng.uniform(1.2, 1.5)),
        shift=(float(rng.uniform(-0.08, 0.08)), float(rng.uniform(-0.08, 0.08))),
        turn_rad=float(rng.uniform(-np.pi / 8, np.pi / 8)),
        mirrored=bool(rng.random() < 0.5),
        gain=float(rng.uniform(0.6, 1.4)),
        offset_dn=float(rng.uniform(-20, 20)),
        blur_px=float(rng.uniform(0.3, 1.5)) if rng.random() < 0.4 else 0.0,
        noise_dn=float(rng.uniform(0, 6)),
    )


def crop_from_patch(view: CropView) -> Array:
    """(2, 3) affine map from pixel-centre coordinates of a patch to those of the crop."""
    box_px = PATCH_PX / _PATCH_SIDE
    scale = CROP_PX / (view.side * box_px)
    cos, sin = scale * np.cos(view.turn_rad), scale * np.sin(view.turn_rad)
    linear = np.array([[cos, -sin], [sin, cos]]) @ np.diag([-1.0 if view.mirrored else 1.0, 1.0])
    middle = (PATCH_PX - 1) / 2 + box_px * np.array(view.shift)
    return np.column_stack([linear, (CROP_PX - 1) / 2 - linear @ middle])


def build_crop(patch: NDArray[np.uint8], view: CropView, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
    """(CROP_PX, CROP_PX, 3) crop of a patch; `rng` draws its noise, and is not used where there is none.

    Raises:
        ValueError: noise without a generator.
    """
    crop = cv2.warpAffine(
        patch,
        crop_from_patch(view),
        (CROP_PX, CROP_PX),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(_PADDING_DN, _PADDING_DN, _PADDING_DN),
    )
    if view.blur_px:
        crop = cv2.GaussianBlur(crop, (0, 0), view.blur_px)
    if view == CropView():
        return np.array(crop, dtype=np.uint8)
    values = view.gain * crop.astype(np.float32) + np.float32(view.offset_dn)
    if view.noise_dn:
        if rng is None:
            raise ValueError("rng: noise needs a generator")
        values += np.float32(view.noise_dn) * rng.standard_normal(values.shape, dtype=np.float32)
    augmented: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return augmented


def map_points(affine: Array, points: Array) -> Array:
    """(..., 2) points under a (2, 3) affine map."""
    mapped: Array = points @ affine[:, :2].T + affine[:, 2]
    return mapped


def inverse_affine(affine: Array) -> Array:
    """(2, 3) inverse of an affine map."""
    linear = np.linalg.inv(affine[:, :2])
    return np.column_stack([linear, -linear @ affine[:, 2]])


def image_from_crop(patch: Patch, view: CropView) -> Array:
    """(2, 3) affine map from pixel-centre coordinates of a crop to those of the whole image."""
    patch_from_crop = inverse_affine(crop_from_patch(view))
    linear = patch.image_from_patch[:, :2] @ patch_from_crop[:, :2]
    return np.column_stack([linear, map_points(patch.image_from_patch, patch_from_crop[:, 2])])
