"""The training loss: task-aligned assignment, quality focal loss of the scores, and CIoU loss of the boxes.

Boxes here are (..., 4): left, top, right, bottom. [px]

Sources: assignment, TOOD (Feng et al. 2021, arXiv:2108.07755, section 3.2); score, quality focal loss (Li et al. 2020,
arXiv:2006.04388, eq. 3); box, complete IoU (Zheng et al. 2020, arXiv:1911.08287, eq. 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from nav.detector.network.head import anchor_points, decode_boxes, flatten_maps

_MIN_AREA_PX2 = 1e-6  # keeps quotients finite where a box is empty
# The alignment of a cell with a box is score^a IoU^b; this many of the best aligned cells are assigned to the box.
_SCORE_POWER, _IOU_POWER = 0.5, 6.0
_CELLS_PER_BOX = 10
_TINY = 1e-12
# Exponent by which cells whose score is nearly right are weighted down (quality focal loss, arXiv:2006.04388, eq. 3).
# The paper has 2, with which scores rose later in short trainings on few images; 0 is plain cross entropy, in which the
# few cells of a box have little weight beside the many others. Long trainings were not compared.
_FOCUS_POWER = 1.0
_BOX_WEIGHT = 2.0


def intersection_over_union(a: Tensor, b: Tensor) -> Tensor:
    """IoU of boxes that broadcast against each other: (..., 4) and (..., 4) -> (...)."""
    sides = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0)
    shared = sides[..., 0] * sides[..., 1]
    return shared / (_area(a) + _area(b) - shared).clamp(min=_MIN_AREA_PX2)


def complete_iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU minus penalties for the distance of the centres and the difference of aspect ratios (CIoU).

    It is differentiable, lies between -1.5 and 1, and has a useful gradient also where boxes do not touch.
    Source: arXiv:1911.08287, eq. 10.

    Args:
        a: (N, 4) predictions.
        b: (N, 4) truth.

    Returns:
        (N,)
    """
    iou = intersection_over_union(a, b)
    hull = torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])
    center_offset = (a[:, :2] + a[:, 2:] - b[:, :2] - b[:, 2:]) / 2
    distance = center_offset.square().sum(dim=1) / hull.square().sum(dim=1).clamp(min=_MIN_AREA_PX2)
    aspect = (4 / pi**2) * (_diagonal_angle(a) - _diagonal_angle(b)).square()
    with torch.no_grad():
        weight = aspect / (1 - iou + aspect).clamp(min=_MIN_AREA_PX2)
    return iou - distance - weight * aspect


def _area(boxes: Tensor) -> Tensor:
    sides = boxes[..., 2:] - boxes[..., :2]
    return sides[..., 0] * sides[..., 1]


def _diagonal_angle(boxes: Tensor) -> Tensor:
    sides = (boxes[:, 2:] - boxes[:, :2]).clamp(min=_MIN_AREA_PX2)
    return torch.atan2(sides[:, 0], sides[:, 1])


class Assignment(NamedTuple):
    """The targets of the cells of a batch.

    Attributes:
        scores: (B, N) target scores, 0 to 1; 0 for background cells.
        box_index: (B, N) index of the box of its image that a cell is assigned to; 0 for background cells.
        foreground: (B, N) bool: the cell is assigned to a box.
    """

    scores: Tensor
    box_index: Tensor
    foreground: Tensor


@torch.no_grad()
def assign_anchors(
    scores: Tensor, boxes_px: Tensor, centers_px: Tensor, truth_px: Tensor, is_box: Tensor
) -> Assignment:
    """Assign cells to every true box (task-aligned assignment).

    The candidates of a box are the cells whose centre lies in it; a box that is too small to have any gets the nearest
    cell. A cell that is among the best of several boxes is assigned to the one with the highest IoU. The target score
    of a cell is its alignment relative to the best alignment of the box, times the best IoU, so that a score also
    measures the quality of the box.

    Args:
        scores: (B, N) predicted scores, 0 to 1.
        boxes_px: (B, N, 4) predicted boxes: left, top, right, bottom.
        centers_px: (N, 2) centres of the cells, finer maps first.
        truth_px: (B, M, 4) true boxes: left, top, right, bottom; M at least 1.
        is_box: (B, M) bool: false for rows of `truth_px` that are padding.
    """
    is_candidate = _candidate_cells(centers_px, truth_px) & is_box[:, :, None]
    iou = intersection_over_union(truth_px[:, :, None], boxes_px[:, None])
    alignment = (scores[:, None].pow(_SCORE_POWER) * iou.pow(_IOU_POWER)).clamp(min=_TINY) * is_candidate
    best = alignment.topk(min(_CELLS_PER_BOX, alignment.shape[2]), dim=2).indices
    assigned = torch.zeros_like(is_candidate).scatter_(2, best, True) & is_candidate
    box_index = torch.where(assigned, iou, -1.0).argmax(dim=1)
    assigned &= functional.one_hot(box_index, assigned.shape[1]).transpose(1, 2).bool()
    alignment, iou = alignment * assigned, iou * assigned
    quality = alignment / alignment.amax(dim=2, keepdim=True).clamp(min=_TINY) * iou.amax(dim=2, keepdim=True)
    return Assignment(quality.amax(dim=1), box_index, assigned.any(dim=1))


def _candidate_cells(centers_px: Tensor, truth_px: Tensor) -> Tensor:
    """(B, M, N) whether a cell's centre lies within a box, or is the nearest to a box that contains none."""
    low = centers_px - truth_px[:, :, None, :2]
    high = truth_px[:, :, None, 2:] - centers_px
    inside = torch.cat((low, high), dim=3).amin(dim=3) > 0
    middle_px = (truth_px[..., :2] + truth_px[..., 2:]) / 2
    # Of equally near cells the first is taken, that of the finest map.
    nearest = (centers_px - middle_px[:, :, None]).square().sum(dim=3).argmin(dim=2)
    only = functional.one_hot(nearest, centers_px.shape[0]).bool()
    return torch.where(inside.any(dim=2, keepdim=True), inside, only)


class DetectionLoss(NamedTuple):
    """Losses of a batch, float32 scalars.

    Attributes:
        total: the loss that is minimised: `score` plus a multiple of `box`.
        score: quality focal loss of the scores; the target is the quality of the cell's box.
        box: 1 - CIoU of the boxes, weighted by the target scores.
    """

    total: Tensor
    score: Tensor
    box: Tensor


def detection_loss(maps: Sequence[Tensor], boxes_xywh_px: Sequence[Tensor]) -> DetectionLoss:
    """Loss of a batch, computed in float32 whatever the dtype of the maps.

    Args:
        maps: the network's output, three times (B, 5, H, W).
        boxes_xywh_px: for each image (n, 4) true boxes in corner coordinates of the input; n may be 0.

    Raises:
        ValueError: another number of box arrays than images, or boxes that are not (n, 4).
    """
    images, device = maps[0].shape[0], maps[0].device
    if len(boxes_xywh_px) != images:
        raise ValueError(f"boxes_xywh_px: must be one for each of {images} images, got {len(boxes_xywh_px)}")
    for boxes in boxes_xywh_px:
        if boxes.ndim != 2 or boxes.shape[1] != 4:
            raise ValueError(f"boxes_xywh_px: must be (n, 4), got {tuple(boxes.shape)}")
    with torch.autocast(device.type, enabled=False):
        anchors = anchor_points(maps)
        cells = flatten_maps(maps)
        logits, predicted_px = cells[..., 0], decode_boxes(cells[..., 1:], anchors)
        truth_px, is_box = _pad_boxes(boxes_xywh_px, device)
        targets = assign_anchors(logits.sigmoid(), predicted_px, anchors.centers_px, truth_px, is_box)
        normalizer = targets.scores.sum().clamp(min=1.0)
        score = _quality_focal_loss(logits, targets.scores).sum() / normalizer
        target_px = truth_px.gather(1, targets.box_index[..., None].expand(-1, -1, 4))
        on = targets.foreground
        box = ((1 - complete_iou(predicted_px[on], target_px[on])) * targets.scores[on]).sum() / normalizer
    return DetectionLoss(score + _BOX_WEIGHT * box, score, box)


def _pad_boxes(boxes_xywh_px: Sequence[Tensor], device: torch.device) -> tuple[Tensor, Tensor]:
    """(B, M, 4) left, top, right, bottom, and (B, M) which rows are boxes and not padding; M at least 1."""
    max_boxes = max(1, *(len(boxes) for boxes in boxes_xywh_px))
    rows = [boxes.to(device, torch.float32) for boxes in boxes_xywh_px]
    xywh = pad_sequence([*rows, torch.zeros((max_boxes, 4), device=device)], batch_first=True)[:-1]
    counts = torch.tensor([len(boxes) for boxes in boxes_xywh_px], device=device)
    is_box = torch.arange(max_boxes, device=device) < counts[:, None]
    return torch.cat((xywh[..., :2], xywh[..., :2] + xywh[..., 2:]), dim=-1), is_box


def _quality_focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Cross entropy with targets between 0 and 1, weighted by the distance of the score from its target."""
    distance = (targets - logits.sigmoid()).abs().pow(_FOCUS_POWER)
    return distance * functional.binary_cross_entropy_with_logits(logits, targets, reduction="none")
