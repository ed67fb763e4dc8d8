from __future__ import annotations

from math import exp, log

import pytest
import torch
from pycocotools import mask

from nav.detector.network.head import LossWeights, detection_loss
from nav.detector.network.network import NetworkConfig
from nav.detector.output_maps import STRIDES, decode_maps
from tests.support.detector_networks import make_network

HEIGHT, WIDTH = 128, 160
NONE = torch.zeros(0, 4)
BOXES = [torch.tensor([[20.0, 30.0, 17.0, 18.0], [60.0, 20.0, 90.0, 95.0]]), NONE]


def blank_maps(images: int, logit: float = -4.6) -> list[torch.Tensor]:
    """Maps that predict no drogue and boxes of four strides."""
    maps = []
    for stride in STRIDES:
        each = torch.full((images, 5, HEIGHT // stride, WIDTH // stride), 0.7)
        each[:, 0] = logit
        maps.append(each)
    return maps


def perfect_maps(box: tuple[float, float, float, float], shift_px: float = 0.0) -> list[torch.Tensor]:
    """Maps in which every cell within a box predicts it, shifted to the right."""
    x, y, width, height = box
    maps = blank_maps(1)
    for stride, each in zip(STRIDES, maps, strict=True):
        for row in range(each.shape[2]):
            for column in range(each.shape[3]):
                u, v = (column + 0.5) * stride, (row + 0.5) * stride
                sides = torch.tensor([u - x - shift_px, v - y, x + width + shift_px - u, y + height - v])
                if bool((sides > 0).all()):
                    each[0, 1:, row, column] = (sides / stride).log()
    return maps


def test_loss_of_right_boxes_is_zero_and_grows_with_their_shift() -> None:
    box = (40.0, 30.0, 61.0, 53.0)
    losses = [
        detection_loss(perfect_maps(box, shift_px), [torch.tensor([box])]).box.item() for shift_px in (0, 1, 2, 4, 8)
    ]
    # exp(log(x)) in float32 of sides of tens of pixels.
    assert losses[0] == pytest.approx(0, abs=1e-5)
    assert losses == sorted(losses) and losses[1] > 1e-3


def test_images_without_boxes_only_push_scores_down() -> None:
    maps = [each.requires_grad_() for each in blank_maps(2)]
    loss = detection_loss(maps, [NONE, NONE])
    loss.total.backward()
    assert loss.box.item() == 0
    for each in maps:
        assert each.grad is not None
        assert bool((each.grad[:, 0] > 0).all())
        assert bool((each.grad[:, 1:] == 0).all())


def test_an_image_without_boxes_does_not_disturb_its_neighbours() -> None:
    maps = blank_maps(2)
    alone = detection_loss([each[:1] for each in maps], BOXES[:1])
    both = detection_loss(maps, BOXES)
    assert both.box.item() == pytest.approx(alone.box.item(), rel=1e-5)
    assert both.score.item() >= alone.score.item()


def test_minimising_the_loss_makes_the_predictions_right() -> None:
    """Maps are optimised without a network: assignment, loss and decoding in numpy use the same box coordinates."""
    maps = [each.requires_grad_() for each in blank_maps(2)]
    optimiser = torch.optim.Adam(maps, lr=0.1)
    for _ in range(120):
        loss = detection_loss(maps, BOXES)
        optimiser.zero_grad()
        loss.total.backward()
        optimiser.step()
    found, empty = decode_maps([each.detach().numpy() for each in maps], least_score=0.1)
    assert len(empty[1]) == 0
    assert len(found[1]) == 2
    assert (found[1] > 0.8).all()
    for box in BOXES[0].numpy():
        # The accuracy that so few steps reach: half a pixel on each side of 17.
        assert mask.iou(found[0], box[None], [0]).max() > 0.9


@pytest.mark.parametrize("boxes", [BOXES, [NONE, NONE]], ids=["boxes", "none"])
def test_gradients_in_autocast_are_float32_and_finite(boxes: list[torch.Tensor]) -> None:
    torch_network = make_network(NetworkConfig("s")).train()
    images = torch.rand(2, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = detection_loss(torch_network(images), boxes)
    loss.total.backward()
    assert loss.total.dtype == torch.float32
    for name, weight in torch_network.named_parameters():
        assert weight.grad is not None and weight.grad.dtype == torch.float32, name
        assert bool(weight.grad.isfinite().all()), name


def test_extreme_predictions_keep_the_loss_finite() -> None:
    for logit, log_distance in ((80.0, 50.0), (-80.0, -50.0)):
        maps = [torch.full_like(each, log_distance) for each in blank_maps(2)]
        for each in maps:
            each[:, 0] = logit
            each.requires_grad_()
        loss = detection_loss(maps, BOXES)
        loss.total.backward()
        assert bool(loss.total.isfinite())
        assert all(each.grad is not None and bool(each.grad.isfinite().all()) for each in maps)


@pytest.mark.parametrize(
    ("boxes", "message"), [([NONE], "one for each of 2 images, got 1"), ([NONE, torch.zeros(4)], r"must be \(n, 4\)")]
)
def test_boxes_that_fit_no_batch_are_refused(boxes: list[torch.Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=f"boxes_xywh_px: .*{message}"):
        detection_loss(blank_maps(2), boxes)


def test_the_weights_of_the_loss_in_closed_form() -> None:
    logit = -1.0
    maps = blank_maps(2, logit)
    plain = detection_loss(maps, BOXES, LossWeights(focus_power=0.0, box_weight=3.0))
    focused = detection_loss(maps, BOXES, LossWeights(focus_power=2.0, box_weight=7.0))
    assert plain.total.item() == pytest.approx(plain.score.item() + 3 * plain.box.item(), rel=1e-6)
    assert focused.total.item() == pytest.approx(focused.score.item() + 7 * focused.box.item(), rel=1e-6)
    assert plain.box.item() == focused.box.item()
    # Without boxes all targets are 0 and the divisor is 1: a cell's cross entropy is log(1 + e^x), its score s(x).
    cells = sum(HEIGHT // stride * (WIDTH // stride) for stride in STRIDES)
    score = 1 / (1 + exp(-logit))
    for power in (0.0, 1.0, 2.0):
        loss = detection_loss(blank_maps(1, logit), [NONE], LossWeights(focus_power=power))
        assert loss.score.item() == pytest.approx(cells * score**power * log(1 + exp(logit)), rel=1e-5)
