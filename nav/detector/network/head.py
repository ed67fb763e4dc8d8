"""The detection head, its anchor points and the boxes that it predicts at them, and the loss that trains them.

The head's maps are described in `nav.detector.output_maps`. The loss is task-aligned assignment, quality focal loss of
the scores, and CIoU loss of the boxes. Boxes here are (..., 4): left, top, right, bottom. [px]

Sources: head, YOLOX (Ge et al. 2021, arXiv:2107.08430); assignment, TOOD (Feng et al. 2021, arXiv:2108.07755, section
3.2); score, quality focal loss (Li et al. 2020, arXiv:2006.04388, eq. 3); box, complete IoU (Zheng et al. 2020,
arXiv:1911.08287, eq. 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, pi
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from nav.detector.network.backbone import separable
from nav.detector.output_maps import LOG_DISTANCE_RANGE, MAP_CHANNELS, STRIDES

# Initial score of every cell, so that the many empty cells do not dominate the loss (RetinaNet, arXiv:1708.02002,
# section 4.1).
_PRIOR_SCORE = 0.01
# Initial distance of the sides in strides: boxes of 32, 64 and 128 px on the three levels; drogues have 17 to 340 px.
_PRIOR_DISTANCE = 2.0
_PREDICTION_SD = 0.01


class DetectionHead(nn.Module):
    """One-stage, anchor-free head of one level, decoupled: score and box have convolutions of their own.

    Source: YOLOX, arXiv:2107.08430.
    """

    def __init__(self, channels: int, depth: int) -> None:
        super().__init__()
        self.score_features = nn.Sequential(*(separable(channels) for _ in range(depth)))
        self.box_features = nn.Sequential(*(separable(channels) for _ in range(depth)))
        self.score = nn.Conv2d(channels, 1, 1)
        self.box = nn.Conv2d(channels, MAP_CHANNELS - 1, 1)

    def initialize_priors(self) -> None:
        """Set the last layers so that all cells predict nearly the prior score and distances."""
        for layer, bias in ((self.score, log(_PRIOR_SCORE / (1 - _PRIOR_SCORE))), (self.box, log(_PRIOR_DISTANCE))):
            assert layer.bias is not None
            nn.init.normal_(layer.weight, std=_PREDICTION_SD)
            nn.init.constant_(layer.bias, bias)

    def initialize_score(self, prior: float) -> None:
        """Set the bias of the score so that all cells predict nearly this score."""
        assert self.score.bias is not None
        nn.init.constant_(self.score.bias, log(prior / (1 - prior)))

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, 5, H, W), see `nav.detector.output_maps`; always float32, also in autocast."""
        score_features: Tensor = self.score_features(features)
        box_features: Tensor = self.box_features(features)
        device = features.device.type
        if not torch.is_autocast_enabled(device):
            return torch.cat((self.score(score_features), self.box(box_features)), dim=1)
        # bf16 has 8 significant bits: it would round distances to half a percent of the box.
        with torch.autocast(device, enabled=False):
            return torch.cat((self.score(score_features.float()), self.box(box_features.float())), dim=1)


class AnchorPoints(NamedTuple):
    """The anchor points of N cells, of all maps.

    Attributes:
        centers_px: (N, 2) x, y from the corner of the input. [px]
        strides_px: (N, 1) stride of each cell's map. [px]
    """

    centers_px: Tensor
    strides_px: Tensor


def anchor_points(maps: Sequence[Tensor]) -> AnchorPoints:
    """The anchor points of maps (B, 5, H, W), the finest map first, row by row."""
    centers, strides = [], []
    for stride, each in zip(STRIDES, maps, strict=True):
        rows, columns = (
            (torch.arange(count, device=each.device, dtype=torch.float32) + 0.5) * stride for count in each.shape[2:]
        )
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        centers.append(torch.stack((x.flatten(), y.flatten()), dim=1))
        strides.append(torch.full((x.numel(), 1), float(stride), device=each.device))
    return AnchorPoints(torch.cat(centers), torch.cat(strides))


def flatten_maps(maps: Sequence[Tensor]) -> Tensor:
    """(B, N, 5) of float32 from maps (B, 5, H, W), in the order of `anchor_points`."""
    return torch.cat([each.float().flatten(2) for each in maps], dim=2).transpose(1, 2)


def decode_boxes(log_distances: Tensor, anchors: AnchorPoints) -> Tensor:
    """Decode the boxes of all cells.

    Args:
        log_distances: (B, N, 4) logarithms of the distances to left, top, right, bottom, in strides.
        anchors: the cells' anchor points.

    Returns:
        (B, N, 4) left, top, right, bottom. [px]
    """
    distances_px = log_distances.clamp(*LOG_DISTANCE_RANGE).exp() * anchors.strides_px
    low_px = anchors.centers_px - distances_px[..., :2]
    return torch.cat((low_px, anchors.centers_px + distances_px[..., 2:]), dim=-1)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss, and the size of the assignment.

    Attributes:
        cells_per_box: number of the best aligned cells that are assigned to a box.
        focus_power: exponent by which cells whose score is nearly right are weighted down (quality focal loss,
            arXiv:2006.04388, eq. 3, where it is 2); 0 is plain cross entropy.
        box_weight: of the boxes' loss beside the scores'.
    """

    cells_per_box: int = 10
    focus_power: float = 1.0
    box_weight: float = 2.0


_MIN_AREA_PX2 = 1e-6  # keeps quotients finite where a box is empty
# The alignment of a cell with a box is score^a IoU^b; the best aligned cells are assigned to the box.
_SCORE_POWER, _IOU_POWER = 0.5, 6.0
_TINY = 1e-12


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
    scores: Tensor,
    boxes_px: Tensor,
    centers_px: Tensor,
    truth_px: Tensor,
    is_box: Tensor,
    cells_per_box: int = LossWeights.cells_per_box,
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
        cells_per_box: largest number of cells of a box.
    """
    is_candidate = _candidate_cells(centers_px, truth_px) & is_box[:, :, None]
    iou = intersection_over_union(truth_px[:, :, None], boxes_px[:, None])
    alignment = (scores[:, None].pow(_SCORE_POWER) * iou.pow(_IOU_POWER)).clamp(min=_TINY) * is_candidate
    best = alignment.topk(min(cells_per_box, alignment.shape[2]), dim=2).indices
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


def detection_loss(
    maps: Sequence[Tensor], boxes_xywh_px: Sequence[Tensor], weights: LossWeights = LossWeights()
) -> DetectionLoss:
    """Loss of a batch, computed in float32 whatever the dtype of the maps.

    Args:
        maps: the network's output, three times (B, 5, H, W).
        boxes_xywh_px: for each image (n, 4) true boxes in corner coordinates of the input; n may be 0.
        weights: of the loss and the assignment.

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
        targets = assign_anchors(
            logits.sigmoid(), predicted_px, anchors.centers_px, truth_px, is_box, weights.cells_per_box
        )
        normalizer = targets.scores.sum().clamp(min=1.0)
        score = _quality_focal_loss(logits, targets.scores, weights.focus_power).sum() / normalizer
        target_px = truth_px.gather(1, targets.box_index[..., None].expand(-1, -1, 4))
        on = targets.foreground
        box = ((1 - complete_iou(predicted_px[on], target_px[on])) * targets.scores[on]).sum() / normalizer
    return DetectionLoss(score + weights.box_weight * box, score, box)


def _pad_boxes(boxes_xywh_px: Sequence[Tensor], device: torch.device) -> tuple[Tensor, Tensor]:
    """(B, M, 4) left, top, right, bottom, and (B, M) which rows are boxes and not padding; M at least 1."""
    max_boxes = max(1, *(len(boxes) for boxes in boxes_xywh_px))
    rows = [boxes.to(device, torch.float32) for boxes in boxes_xywh_px]
    xywh = pad_sequence([*rows, torch.zeros((max_boxes, 4), device=device)], batch_first=True)[:-1]
    counts = torch.tensor([len(boxes) for boxes in boxes_xywh_px], device=device)
    is_box = torch.arange(max_boxes, device=device) < counts[:, None]
    return torch.cat((xywh[..., :2], xywh[..., :2] + xywh[..., 2:]), dim=-1), is_box


def _quality_focal_loss(logits: Tensor, targets: Tensor, focus_power: float) -> Tensor:
    """Cross entropy with targets between 0 and 1, weighted by the distance of the score from its target."""
    distance = (targets - logits.sigmoid()).abs().pow(focus_power)
    return distance * functional.binary_cross_entropy_with_logits(logits, targets, reduction="none")
