"""Drogues that are cut out of rendered images and pasted into other images, in other paint and light.

The network then sees drogues before things that no frame has behind them, and in colours that no recipe draws. Sources:
Ghiasi et al. 2021, "Simple Copy-Paste is a Strong Data Augmentation Method for Instance Segmentation",
arXiv:2012.07177; for colours that need not be physical, Tobin et al. 2017, arXiv:1703.06907.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.records import ViewRecord
from drogue_models.frozen_model import FrozenModel
from drogue_models.parts import MAX_MARKERS, Part, drogue_part_ids
from nav.detector.input_image import Letterbox
from nav.training.augmentation import Boxes, Image, saturate

Alpha = NDArray[np.uint8]

_PARTS = (*drogue_part_ids(MAX_MARKERS), int(Part.HOSE))
_HOSE_FRACTION = 0.35  # of the box's longer side: so much hose is cut out around it
_WHOLE_WITHIN_PX = 1.0  # no side of the visible box may be further inside that of the whole drogue
_SMALLEST_PX = 16.0  # of the longer side; smaller ones are a few mixed pixels
# Longer side of a pasted drogue over the height of the image, and the most that a cut-out is enlarged.
_PASTED_SIZE, _MOST_ENLARGED = (0.03, 0.8), 1.5
_SOFT_EDGE_SIGMA_PX = 0.6
# The looks: paint and light of the encoded picture, from black to white ones, grey ones and negatives.
_GAIN, _GAMMA, _SATURATION = (0.3, 1.6), (0.6, 2.0), (0.0, 1.5)
_GREY_FRACTION, _NEGATIVE_FRACTION = 0.3, 0.1
_MARGIN_PX = 4  # beside a cut-out, for its soft edge
_LEAST_CONTRAST_DN = 25.0  # a drogue that would hardly be seen is shown as its negative
# What may stand before a drogue; where it is within the box, it may hide the drogue's middle and no edge.
_HIDING_PARTS = (int(Part.PROBE), int(Part.OBSTACLE), int(Part.DISTRACTOR))
_INSET = 0.4  # of half its size the centre of a pasted drogue is away from the image's edges: half of it is in view


class Cutout(FrozenModel):
    """Where a drogue is cut out of an image.

    Attributes:
        x, y, width, height: of the rectangle around drogue and hose, in whole pixels of the image. [px]
        offset: of its opacities in the file of all.
    """

    x: int
    y: int
    width: int
    height: int
    offset: int


class Look(NamedTuple):
    """How the colours of a drogue change.

    Attributes:
        gain, gamma: of encoded values from 0 to 1.
        saturation: 0 grey, 1 as it was.
        is_negative: bright becomes dark, after everything else.
    """

    gain: float = 1.0
    gamma: float = 1.0
    saturation: float = 1.0
    is_negative: bool = False


class Paste(NamedTuple):
    """How a cut-out is pasted.

    Attributes:
        pair: of the drogue.
        scale: pixels of the new image per pixel of the old one.
        center_px: x, y of the middle of the drogue's box in the new image. [px]
        look: its colours.
    """

    pair: int
    scale: float
    center_px: tuple[float, float]
    look: Look = Look()


def cut_out(
    part_ids: NDArray[np.uint8], view: ViewRecord, placement: Letterbox, input_wh: tuple[int, int]
) -> tuple[Cutout, Alpha] | None:
    """Cut the sought drogue and the hose near it out of the input image; None where it is not wholly seen.

    Args:
        part_ids: (H, W) of the camera image.
        view: the labels of that eye.
        placement: of the camera image in the network's input.
        input_wh: size of the input. [px]

    Returns:
        The rectangle, of offset 0, and its (height, width) opacities, 0 to 255.
    """
    if view.box_full_xywh_px is None or view.box_visible_xywh_px is None:
        return None
    full, visible = np.array(view.box_full_xywh_px), np.array(view.box_visible_xywh_px)
    sides = np.array([full[:2], full[:2] + full[2:]]) - np.array([visible[:2], visible[:2] + visible[2:]])
    x, y, width, height = placement.to_input(visible)[0]
    if np.abs(sides).max() > _WHOLE_WITHIN_PX or max(width, height) < _SMALLEST_PX:
        return None
    first, last = np.floor(visible[:2]).astype(int), np.ceil(visible[:2] + visible[2:]).astype(int)
    if np.isin(part_ids[first[1] : last[1], first[0] : last[0]], _HIDING_PARTS).any():
        return None
    opaque = np.where(np.isin(part_ids, _PARTS), np.uint8(255), np.uint8(0))
    size = tuple(round(side * scale) for side, scale in zip(opaque.shape[::-1], placement.scale, strict=True))
    interpolation = cv2.INTER_LINEAR if placement.scale[0] > 1 else cv2.INTER_AREA
    alpha = np.zeros(input_wh[::-1], dtype=np.uint8)
    left, top = placement.offset_px
    alpha[top : top + size[1], left : left + size[0]] = cv2.resize(opaque, size, interpolation=interpolation)
    margin = _HOSE_FRACTION * max(width, height)
    low = np.maximum(np.floor([x - margin, y - margin]).astype(int), 0)
    high = np.minimum(np.ceil([x + width + margin, y + height + margin]).astype(int), input_wh)
    found = np.ascontiguousarray(alpha[low[1] : high[1], low[0] : high[0]])
    place = Cutout(x=int(low[0]), y=int(low[1]), width=int(high[0] - low[0]), height=int(high[1] - low[1]), offset=0)
    return place, found


def sample_paste(rng: np.random.Generator, pair: int, box: Boxes, image_wh: tuple[int, int]) -> Paste:
    """Draw size, place and look of a pasted drogue; at least about half of it lies in the image.

    Args:
        rng: random stream.
        pair: that the drogue is cut out of.
        box: (4,) of the drogue in its own image. [px]
        image_wh: size of the image that it is pasted into. [px]
    """
    longest_px = float(box[2:].max())
    smallest_px, largest_px = (fraction * image_wh[1] for fraction in _PASTED_SIZE)
    largest_px = max(min(largest_px, _MOST_ENLARGED * longest_px), smallest_px)
    scale = float(np.exp(rng.uniform(np.log(smallest_px), np.log(largest_px)))) / longest_px
    inset = np.minimum(_INSET * scale * box[2:] / 2, np.array(image_wh) / 2)
    center = rng.uniform(inset, image_wh - inset)
    return Paste(pair, scale, (float(center[0]), float(center[1])), _sample_look(rng))


def _sample_look(rng: np.random.Generator) -> Look:
    gain, gamma = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in (_GAIN, _GAMMA))
    saturation = 0.0 if rng.random() < _GREY_FRACTION else float(rng.uniform(*_SATURATION))
    return Look(gain, gamma, saturation, bool(rng.random() < _NEGATIVE_FRACTION))


def is_clear(pasted: Boxes, others: Boxes) -> bool:
    """Whether a pasted rectangle (4,), drogue and hose, touches none of other boxes (n, 4)."""
    apart = np.abs(others[:, :2] + others[:, 2:] / 2 - pasted[:2] - pasted[2:] / 2)
    return bool((apart > (others[:, 2:] + pasted[2:]) / 2).any(axis=1).all())


def pasted_rectangle(box: Boxes, cutout: Cutout, paste: Paste) -> Boxes:
    """(4,) rectangle that a pasted drogue and its hose cover, from its box (4,) and cut-out in its own image. [px]"""
    corner = paste.center_px + paste.scale * (np.array([cutout.x, cutout.y]) - box[:2] - box[2:] / 2)
    return np.hstack([corner, paste.scale * np.array([cutout.width, cutout.height])])


def pasted_box(box: Boxes, paste: Paste, image_wh: tuple[int, int]) -> Boxes:
    """(1, 4) box of a pasted drogue, clipped to the image, from its box (4,) in its own image. [px]"""
    half = paste.scale * box[2:] / 2
    low, high = np.maximum(paste.center_px - half, 0), np.minimum(paste.center_px + half, image_wh)
    return np.hstack([low, high - low]).reshape(1, 4).astype(np.float64)


def paste_drogue(background: Image, image: Image, box: Boxes, cutout: Cutout, alpha: Alpha, paste: Paste) -> Image:
    """A copy of an image with a drogue in it.

    Args:
        background: (H, W, 3).
        image: (H, W, 3) that the drogue is cut out of.
        box: (4,) of the drogue in it. [px]
        cutout, alpha: its rectangle and (height, width) opacities.
        paste: how it is pasted.
    """
    rows, columns = slice(cutout.y, cutout.y + cutout.height), slice(cutout.x, cutout.x + cutout.width)
    pixels, opacity = _repaint(np.ascontiguousarray(image[rows, columns]), paste.look), np.ascontiguousarray(alpha)
    wanted = tuple(max(round(paste.scale * side), 1) for side in (cutout.width, cutout.height))
    if paste.scale < 1:
        # Averaging first, because the warp would alias a strong reduction.
        pixels = np.asarray(cv2.resize(pixels, wanted, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        opacity = np.asarray(cv2.resize(opacity, wanted, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    scale = paste.scale * np.array([cutout.width / pixels.shape[1], cutout.height / pixels.shape[0]])
    corner, size_px = np.split(pasted_rectangle(box, cutout, paste), 2)
    result = background.copy()
    low = np.maximum(np.floor(corner).astype(int) - _MARGIN_PX, 0)
    high = np.ceil(corner + size_px).astype(int) + _MARGIN_PX
    part = result[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
    if not part.size:
        return result
    # OpenCV counts from pixel centres.
    warp, size = np.column_stack([np.diag(scale), corner - low + scale / 2 - 0.5]), part.shape[1::-1]
    shown = cv2.warpAffine(pixels, warp, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    cover = cv2.GaussianBlur(cv2.warpAffine(opacity, warp, size), (0, 0), _SOFT_EDGE_SIGMA_PX)
    weight = (cover / np.float32(255))[..., None]
    difference = weight * (shown - part.astype(np.float32))
    if np.abs(difference).sum() < _LEAST_CONTRAST_DN * max(float(weight.sum()) * 3, 1.0):
        difference = weight * (255 - shown - part.astype(np.float32))
    part[:] = np.rint(part + difference)
    return result


def _repaint(pixels: Image, look: Look) -> Image:
    level = look.gain * (np.arange(256) / 255) ** look.gamma
    curve = np.rint(255 * np.clip(1 - level if look.is_negative else level, 0, 1)).astype(np.uint8)
    return np.asarray(cv2.LUT(saturate(pixels, look.saturation), curve), dtype=np.uint8)
