"""Which cells answer for which box: task-aligned assignment (TOOD, Feng et al. 2021, arXiv:2108.07755, section 3.2)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nav.detector.network.iou import intersection_over_union

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
def assign(scores: Tensor, boxes_px: Tensor, centers_px: Tensor, truth_px: Tensor, present: Tensor) -> Assignment:
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
