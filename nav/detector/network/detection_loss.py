"""What training makes small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from nav.detector.network.anchor_points import boxes_of, cells_of, in_one_row
from nav.detector.network.assignment import assign
from nav.detector.network.iou import complete_iou

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
        cells = cells_of(maps)
        row = in_one_row(maps)
        logits, answered_px = row[..., 0], boxes_of(row[..., 1:], cells)
        truth_px, present = _padded(boxes_xywh_px, device)
        assigned = assign(logits.sigmoid(), answered_px, cells.centers_px, truth_px, present)
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
