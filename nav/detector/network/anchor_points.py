"""Cells of all three maps in one row, and the boxes that they answer, see `nav.detector.maps`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nav.detector.maps import LOG_DISTANCE_RANGE, STRIDES


class Cells(NamedTuple):
    """N cells of all maps.

    Attributes:
        centers_px: (N, 2) x, y from the corner of the input.
        strides_px: (N, 1)
    """

    centers_px: Tensor
    strides_px: Tensor


def cells_of(maps: Sequence[Tensor]) -> Cells:
    """Places of the cells of maps (B, 5, H, W), the finest map first, row by row."""
    centers, strides = [], []
    for stride, each in zip(STRIDES, maps, strict=True):
        rows, columns = (
            (torch.arange(count, device=each.device, dtype=torch.float32) + 0.5) * stride for count in each.shape[2:]
        )
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        centers.append(torch.stack((x.flatten(), y.flatten()), dim=1))
        strides.append(torch.full((x.numel(), 1), float(stride), device=each.device))
    return Cells(torch.cat(centers), torch.cat(strides))


def in_one_row(maps: Sequence[Tensor]) -> Tensor:
    """(B, N, 5) of float32 from maps (B, 5, H, W), in the order of `cells_of`."""
    return torch.cat([each.float().flatten(2) for each in maps], dim=2).transpose(1, 2)


def boxes_of(log_distances: Tensor, cells: Cells) -> Tensor:
    """Boxes of all cells.

    Args:
        log_distances: (B, N, 4) logarithms of the distances to left, top, right, bottom in strides.
        cells: where they are.

    Returns:
        (B, N, 4) left, top, right, bottom. [px]
    """
    distances_px = log_distances.clamp(*LOG_DISTANCE_RANGE).exp() * cells.strides_px
    low_px = cells.centers_px - distances_px[..., :2]
    return torch.cat((low_px, cells.centers_px + distances_px[..., 2:]), dim=-1)
