from __future__ import annotations

import numpy as np
import pytest
import torch
from pycocotools import mask

from nav.detector.network.head import anchor_points, assign_anchors, complete_iou, decode_boxes, intersection_over_union

CELLS = anchor_points([torch.zeros(1, 5, 128 // stride, 160 // stride) for stride in (8, 16, 32)])
MAX_CELLS = 10


def corners(xywh: list[tuple[float, float, float, float]]) -> torch.Tensor:
    boxes = torch.tensor(xywh, dtype=torch.float32).reshape(-1, 4)
    return torch.cat((boxes[:, :2], boxes[:, :2] + boxes[:, 2:]), dim=1)


def random_predictions(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    count = len(CELLS.centers_px)
    boxes = decode_boxes(torch.randn(1, count, 4, generator=generator), CELLS)
    return torch.rand(1, count, generator=generator), boxes


def test_anchor_points_are_the_centres_of_their_cells() -> None:
    for stride, offset, shape in ((8, 0, (16, 20)), (16, 320, (8, 10)), (32, 400, (4, 5))):
        for row, column in ((0, 0), (1, 2), (shape[0] - 1, shape[1] - 1)):
            index = offset + row * shape[1] + column
            assert CELLS.centers_px[index].tolist() == [(column + 0.5) * stride, (row + 0.5) * stride]
            assert CELLS.strides_px[index].item() == stride


def test_iou_agrees_with_pycocotools() -> None:
    rng = np.random.default_rng(1)
    a, b = (np.hstack((rng.uniform(0, 60, (7, 2)), rng.uniform(5, 60, (7, 2)))) for _ in range(2))
    ours = intersection_over_union(corners(a.tolist())[:, None], corners(b.tolist())[None])
    # float32 against float64, from numbers of some hundreds.
    np.testing.assert_allclose(ours.numpy(), mask.iou(a, b, [0] * 7), atol=1e-5)


def test_complete_iou_in_closed_form() -> None:
    square = (10.0, 20.0, 40.0, 40.0)
    half = (20.0, 30.0, 20.0, 20.0)
    beside = (110.0, 20.0, 40.0, 40.0)
    got = complete_iou(corners([square, half, beside]), corners([square] * 3))
    # Equal; a quarter of the area in the same middle; apart by 100 in a hull of 140x40.
    torch.testing.assert_close(got, torch.tensor([1.0, 0.25, -(100**2) / (140**2 + 40**2)]), rtol=1e-5, atol=1e-6)


def test_complete_iou_has_a_gradient_for_boxes_that_do_not_touch() -> None:
    box = corners([(100.0, 0.0, 10.0, 10.0)]).requires_grad_()
    complete_iou(box, corners([(0.0, 0.0, 10.0, 10.0)])).sum().backward()
    assert box.grad is not None
    # Both sides moved at once.
    assert (box.grad[0, 0] + box.grad[0, 2]).item() < -1e-4


@pytest.mark.parametrize("seed", range(8))
def test_cells_are_assigned_to_boxes_that_contain_them(seed: int) -> None:
    truth = corners([(5, 9, 17, 17), (60, 10, 70, 90), (3, 60, 40, 50)])
    scores, boxes = random_predictions(seed)
    present = torch.tensor([[True, True, True, False]])
    filled = torch.cat((truth, torch.tensor([[0.0, 0, 160, 128]])))[None]
    assigned = assign_anchors(scores, boxes, CELLS.centers_px, filled, present)
    iou = intersection_over_union(filled[0][:, None], boxes[0][None])
    for index in range(3):
        cells = torch.nonzero(assigned.foreground[0] & (assigned.box_index[0] == index))[:, 0]
        assert 1 <= len(cells) <= MAX_CELLS
        places, box = CELLS.centers_px[cells], truth[index]
        assert bool(((places > box[:2]) & (places < box[2:])).all())
        # The target score of the best aligned cell is the best IoU, and no other is higher.
        assert assigned.scores[0, cells].max().item() == pytest.approx(iou[index, cells].max().item(), rel=1e-5)
    assert not bool((assigned.box_index[0][assigned.foreground[0]] == 3).any())
    assert bool((assigned.scores[0][~assigned.foreground[0]] == 0).all())


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_boxes_does_not_matter(seed: int) -> None:
    truth = corners([(5, 9, 60, 50), (30, 20, 70, 90), (3, 60, 40, 50)])
    scores, boxes = random_predictions(seed)
    present = torch.ones(1, 3, dtype=torch.bool)
    order = torch.tensor([2, 0, 1])
    plain = assign_anchors(scores, boxes, CELLS.centers_px, truth[None], present)
    turned = assign_anchors(scores, boxes, CELLS.centers_px, truth[order][None], present)
    assert torch.equal(plain.foreground, turned.foreground)
    torch.testing.assert_close(plain.scores, turned.scores)
    assert torch.equal(plain.box_index[plain.foreground], order[turned.box_index[turned.foreground]])


def test_a_box_without_cells_gets_the_nearest_one() -> None:
    scores, boxes = random_predictions(3)
    truth = corners([(45.0, 53.0, 2.0, 2.0)])
    assigned = assign_anchors(scores, boxes, CELLS.centers_px, truth[None], torch.ones(1, 1, dtype=torch.bool))
    (cell,) = torch.nonzero(assigned.foreground[0])[:, 0].tolist()
    # The finest map's cell of row 6, column 5.
    assert CELLS.centers_px[cell].tolist() == [44.0, 52.0]
    assert CELLS.strides_px[cell].item() == 8


def test_a_cell_in_two_boxes_is_assigned_to_the_one_with_the_higher_iou() -> None:
    scores, boxes = random_predictions(4)
    outer, inner = (0.0, 0.0, 100.0, 100.0), (20.0, 20.0, 60.0, 60.0)
    boxes = corners([outer])[None].repeat(1, boxes.shape[1], 1)
    assigned = assign_anchors(
        scores, boxes, CELLS.centers_px, corners([inner, outer])[None], torch.ones(1, 2, dtype=torch.bool)
    )
    both = assigned.foreground[0]
    shared = both & (CELLS.centers_px > 20).all(dim=1) & (CELLS.centers_px < 80).all(dim=1)
    taken = assigned.box_index[0][shared & (assigned.scores[0] > 0.5)]
    assert len(taken) and bool((taken == 1).all())


@pytest.mark.parametrize("cells", [1, 3, 25])
def test_a_box_gets_its_best_aligned_cells(cells: int) -> None:
    scores, boxes = random_predictions(5)
    truth = corners([(5.0, 9.0, 110.0, 100.0)])
    present = torch.ones(1, 1, dtype=torch.bool)
    assigned = assign_anchors(scores, boxes, CELLS.centers_px, truth[None], present, cells)
    inside = ((CELLS.centers_px > truth[0, :2]) & (CELLS.centers_px < truth[0, 2:])).all(dim=1)
    alignment = scores[0].sqrt() * intersection_over_union(boxes[0], truth).pow(6) * inside
    best = set(alignment.argsort(descending=True)[:cells].tolist())
    assert set(torch.nonzero(assigned.foreground[0])[:, 0].tolist()) == best
