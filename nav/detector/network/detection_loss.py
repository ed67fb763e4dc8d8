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

_LEAST_AREA_PX2 = 1e-6


def intersection_over_union(a: Tensor, b: Tensor) -> Tensor:
    """IoU of boxes that broadcast against each other: (..., 4) and (..., 4) -> (...)."""
    sides = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0)
    shared = sides[..., 0] * sides[..., 1]
    return shared / (_area(a) + _area(b) - shared).clamp(min=_LEAST_AREA_PX2)


def complete_iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU less the distance of the centres and the difference of the shapes (CIoU, arXiv:1911.08287, eq. 10).

    Differentiable, -1.5 to 1, and still telling where boxes do not touch.

    Args:
        a: (N, 4) answers.
        b: (N, 4) truth.

    Returns:
        (N,)
    """
    iou = intersection_over_union(a, b)
    hull = torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])
    between = (a[:, :2] + a[:, 2:] - b[:, :2] - b[:, 2:]) / 2
    apart = between.square().sum(dim=1) / hull.square().sum(dim=1).clamp(min=_LEAST_AREA_PX2)
    shape = (4 / pi**2) * (_diagonal_angle(a) - _diagonal_angle(b)).square()
    with torch.no_grad():
        weight = shape / (1 - iou + shape).clamp(min=_LEAST_AREA_PX2)
    return iou - apart - weight * shape


def _area(boxes: Tensor) -> Tensor:
    sides = boxes[..., 2:] - boxes[..., :2]
    return sides[..., 0] * sides[..., 1]


def _diagonal_angle(boxes: Tensor) -> Tensor:
    sides = (boxes[:, 2:] - boxes[:, :2]).clamp(min=_LEAST_AREA_PX2)
    return torch.atan2(sides[:, 0], sides[:, 1])


# A cell's claim to a box is score^a IoU^b; so many of the cells with the best claims answer for it.
_SCORE_POWER, _OVERLAP_POWER = 0.5, 6.0
_CELLS_A_BOX = 10
_TINY = 1e-12


class Assignment(NamedTuple):
    """What the cells of a batch should answer.

    Attributes:
        scores: (B, N) 0 to 1; 0 for cells that answer for no box.
        box_index: (B, N) which box of its image a cell answers for; 0 where it answers for none.
        answers: (B, N) bool: the cell answers for a box.
    """

    scores: Tensor
    box_index: Tensor
    answers: Tensor


@torch.no_grad()
def assign_anchors(
    scores: Tensor, boxes_px: Tensor, centers_px: Tensor, truth_px: Tensor, present: Tensor
) -> Assignment:
    """Give every box its cells.

    Cells within a box claim it; a box too small to have any goes to the nearest cell. A cell that is among the best of
    several boxes answers for the one that it overlaps most. The score asked of a cell is its claim relative to the best
    claim, times the best overlap, so that a score also says how good its box is.

    Args:
        scores: (B, N) of the cells, 0 to 1.
        boxes_px: (B, N, 4) of the cells: left, top, right, bottom.
        centers_px: (N, 2) of the cells, finer maps first.
        truth_px: (B, M, 4) true boxes, left, top, right, bottom; M at least 1.
        present: (B, M) bool: false for rows of `truth_px` that only fill up.
    """
    may_claim = _within(centers_px, truth_px) & present[:, :, None]
    overlap = intersection_over_union(truth_px[:, :, None], boxes_px[:, None])
    claim = (scores[:, None].pow(_SCORE_POWER) * overlap.pow(_OVERLAP_POWER)).clamp(min=_TINY) * may_claim
    best = claim.topk(min(_CELLS_A_BOX, claim.shape[2]), dim=2).indices
    chosen = torch.zeros_like(may_claim).scatter_(2, best, True) & may_claim
    box_index = torch.where(chosen, overlap, -1.0).argmax(dim=1)
    chosen &= functional.one_hot(box_index, chosen.shape[1]).transpose(1, 2).bool()
    claim, overlap = claim * chosen, overlap * chosen
    quality = claim / claim.amax(dim=2, keepdim=True).clamp(min=_TINY) * overlap.amax(dim=2, keepdim=True)
    return Assignment(quality.amax(dim=1), box_index, chosen.any(dim=1))


def _within(centers_px: Tensor, truth_px: Tensor) -> Tensor:
    """(B, M, N) whether a cell's centre lies within a box, or is the nearest to a box that holds none."""
    low = centers_px - truth_px[:, :, None, :2]
    high = truth_px[:, :, None, 2:] - centers_px
    inside = torch.cat((low, high), dim=3).amin(dim=3) > 0
    middle_px = (truth_px[..., :2] + truth_px[..., 2:]) / 2
    # The first of equally near ones is that of the finest map.
    nearest = (centers_px - middle_px[:, :, None]).square().sum(dim=3).argmin(dim=2)
    only = functional.one_hot(nearest, centers_px.shape[0]).bool()
    return torch.where(inside.any(dim=2, keepdim=True), inside, only)


# How much less a cell counts whose score is nearly right (quality focal loss, arXiv:2006.04388, eq. 3). It is between
# the 2 of that paper, with which scores rose later in short trainings on few images, and 0, plain cross entropy, in
# which the few cells of a box weigh little beside the many others. Long trainings were not compared.
_FOCUS_POWER = 1.0
_BOX_WEIGHT = 2.0


class DetectionLoss(NamedTuple):
    """Scalars of float32.

    Attributes:
        total: what is differentiated: `score` and a multiple of `box`.
        score: of scores that should be the quality of the cell's box.
        box: of boxes, 1 - CIoU.
    """

    total: Tensor
    score: Tensor
    box: Tensor


def detection_loss(maps: Sequence[Tensor], boxes_xywh_px: Sequence[Tensor]) -> DetectionLoss:
    """Loss of a batch, in float32 whatever the maps are.

    Args:
        maps: the network's answer, three times (B, 5, H, W).
        boxes_xywh_px: of each image (n, 4) true boxes in corner coordinates of the input; n may be 0.

    Raises:
        ValueError: not as many lists of boxes as images, or boxes that are not (n, 4).
    """
    images, device = maps[0].shape[0], maps[0].device
    if len(boxes_xywh_px) != images:
        raise ValueError(f"boxes_xywh_px: must be one for each of {images} images, got {len(boxes_xywh_px)}")
    for boxes in boxes_xywh_px:
        if boxes.ndim != 2 or boxes.shape[1] != 4:
            raise ValueError(f"boxes_xywh_px: must be (n, 4), got {tuple(boxes.shape)}")
    with torch.autocast(device.type, enabled=False):
        cells = anchor_points(maps)
        row = flatten_maps(maps)
        logits, answered_px = row[..., 0], decode_boxes(row[..., 1:], cells)
        truth_px, present = _padded(boxes_xywh_px, device)
        assigned = assign_anchors(logits.sigmoid(), answered_px, cells.centers_px, truth_px, present)
        share = assigned.scores.sum().clamp(min=1.0)
        score = _quality_focal(logits, assigned.scores).sum() / share
        wanted_px = truth_px.gather(1, assigned.box_index[..., None].expand(-1, -1, 4))
        mine = assigned.answers
        box = ((1 - complete_iou(answered_px[mine], wanted_px[mine])) * assigned.scores[mine]).sum() / share
    return DetectionLoss(score + _BOX_WEIGHT * box, score, box)


def _padded(boxes_xywh_px: Sequence[Tensor], device: torch.device) -> tuple[Tensor, Tensor]:
    """(B, M, 4) left, top, right, bottom, and (B, M) which are boxes and which fill up; M at least 1."""
    most = max(1, *(len(boxes) for boxes in boxes_xywh_px))
    rows = [boxes.to(device, torch.float32) for boxes in boxes_xywh_px]
    xywh = pad_sequence([*rows, torch.zeros((most, 4), device=device)], batch_first=True)[:-1]
    counts = torch.tensor([len(boxes) for boxes in boxes_xywh_px], device=device)
    present = torch.arange(most, device=device) < counts[:, None]
    return torch.cat((xywh[..., :2], xywh[..., :2] + xywh[..., 2:]), dim=-1), present


def _quality_focal(logits: Tensor, wanted: Tensor) -> Tensor:
    """Cross entropy to a quality between 0 and 1, weighted by how far the score is from it."""
    distance = (wanted - logits.sigmoid()).abs().pow(_FOCUS_POWER)
    return distance * functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
