"""How well boxes agree. Boxes here are (..., 4): left, top, right, bottom."""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

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
