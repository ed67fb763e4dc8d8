from __future__ import annotations

import json
import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from nav.detector.network.backbone import (
    BLOCKS,
    DepthwiseConv,
    EfficientChannelAttention,
    MobileNetV3,
    SqueezeExcitation,
    eca_kernel_size,
    squeezed_channels,
)
from nav.detector.network.network import (
    AdaptiveFusion,
    DetectorNetwork,
    FusionStart,
    LevelResize,
    NetworkConfig,
    complexity,
)
from nav.detector.output_maps import STRIDES
from tests.support.detector_networks import make_network

CONFIGS = [NetworkConfig(*each) for each in product(("l", "s"), ("eca", "se"), ("asff", "concat"))]
MAX_WEIGHTS_BYTES = 12e6


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: "-".join(config.to_dict().values()))
def test_there_is_one_output_map_per_stride(config: NetworkConfig) -> None:
    height, width = 64, 96
    with torch.no_grad():
        maps = make_network(config)(torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(1)))
    assert [tuple(each.shape) for each in maps] == [(2, 5, height // stride, width // stride) for stride in STRIDES]
    assert all(bool(each.isfinite().all()) for each in maps)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: "-".join(config.to_dict().values()))
def test_configuration_survives_json(config: NetworkConfig) -> None:
    assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"variant": "m"}, "variant: must be one of l, s, got 'm'"),
        ({"fusion": "fpn"}, "fusion: must be one of asff, concat"),
        ({"depth": 3}, "network: has no depth"),
    ],
)
def test_a_configuration_that_does_not_exist_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NetworkConfig.from_dict(values)


# Worked by hand from |log2(C) / 2 + 1/2|: 16 -> 2.5, 64 -> 3.5, 72 -> 3.6, 240 and 256 -> 4.5, 512 -> 5, 960 -> 5.5.
@pytest.mark.parametrize(
    ("channels", "size"), [(8, 3), (16, 3), (64, 3), (72, 3), (240, 5), (256, 5), (512, 5), (960, 5)]
)
def test_eca_kernel_size(channels: int, size: int) -> None:
    assert eca_kernel_size(channels) == size


def test_eca_weighs_a_channel_by_the_means_of_its_neighbours() -> None:
    attention = EfficientChannelAttention(8)
    kernel = torch.tensor([0.3, -0.7, 1.1])
    with torch.no_grad():
        attention.across_channels.weight.copy_(kernel.reshape(1, 1, 3))
    features = torch.randn(2, 8, 5, 6, generator=torch.Generator().manual_seed(2))
    means = np.pad(features.numpy().mean(axis=(2, 3)), ((0, 0), (1, 1)))
    mixed = sum(float(kernel[k]) * means[:, k : k + 8] for k in range(3))
    expected = features.numpy() / (1 + np.exp(-mixed))[:, :, None, None]
    # Sums of 30 float32 numbers near one.
    np.testing.assert_allclose(attention(features).detach().numpy(), expected, rtol=1e-5, atol=1e-6)


# The published MobileNetV3 models of torchvision have these bottlenecks.
@pytest.mark.parametrize(("channels", "squeezed"), [(16, 8), (72, 24), (96, 24), (120, 32), (480, 120), (960, 240)])
def test_squeezed_channels(channels: int, squeezed: int) -> None:
    assert squeezed_channels(channels) == squeezed


# torchvision's mobilenet_v3_large and _small have 5,483,032 and 2,542,856 parameters and, by its tables, 0.217 and
# 0.057 10^9 multiply-adds at 224x224. Their last convolution and classifier, worked by hand, are not part of the
# backbone.
@pytest.mark.parametrize(
    ("variant", "published", "published_multiply_adds", "last", "hidden"),
    [("l", 5_483_032, 0.217e9, (160, 960), 1280), ("s", 2_542_856, 0.057e9, (96, 576), 1024)],
)
def test_backbone_has_the_published_size(
    variant: str, published: int, published_multiply_adds: float, last: tuple[int, int], hidden: int
) -> None:
    backbone = complexity(MobileNetV3(variant, "se"), (224, 224))
    classifier = (last[1] + 1) * hidden + (hidden + 1) * 1000
    assert backbone.parameters + last[0] * last[1] + 2 * last[1] + classifier == published
    end = last[0] * last[1] * 7 * 7 + last[1] * hidden + hidden * 1000
    # The published figures are rounded to 10^6.
    assert abs(backbone.multiply_adds + end - published_multiply_adds) < 0.6e6


@pytest.mark.parametrize("variant", ["l", "s"])
def test_eca_replaces_every_squeeze_and_excitation(variant: str) -> None:
    kinds = {"eca": EfficientChannelAttention, "se": SqueezeExcitation}
    wanted = sum(block.has_attention for block in BLOCKS[variant])
    for name, kind in kinds.items():
        modules = list(MobileNetV3(variant, name).modules())
        assert sum(isinstance(each, kind) for each in modules) == wanted
        assert sum(isinstance(each, tuple(kinds.values())) for each in modules) == wanted


@pytest.mark.parametrize("variant", ["l", "s"])
def test_weights_fit_into_the_package(variant: str) -> None:
    assert 4 * complexity(DetectorNetwork(NetworkConfig(variant)), (64, 64)).parameters < MAX_WEIGHTS_BYTES


def test_fusion_weights_of_each_location_sum_to_one() -> None:
    generator = torch.Generator().manual_seed(3)
    levels = [3 * torch.randn(2, 8, 4, 6, generator=generator) for _ in STRIDES]
    weights = AdaptiveFusion(8).level_weights(levels)
    assert tuple(weights.shape) == (2, 3, 4, 6)
    assert bool((weights > 0).all())
    # Three float32 numbers.
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(2, 4, 6), rtol=0, atol=1e-6)


def test_fusion_of_equal_levels_is_that_level() -> None:
    fusion = AdaptiveFusion(8).eval()
    level = torch.randn(1, 8, 4, 6, generator=torch.Generator().manual_seed(4))
    # A weighted mean of equal numbers in float32, then two convolutions.
    torch.testing.assert_close(fusion([level] * 3), fusion.expand(level), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("stride", "target"), list(product(STRIDES, STRIDES)))
def test_levels_are_resized_to_each_other(stride: int, target: int) -> None:
    features = torch.randn(1, 4, 64 // stride, 96 // stride, generator=torch.Generator().manual_seed(5))
    resized = LevelResize(4, stride, target)(features)
    assert tuple(resized.shape) == (1, 4, 64 // target, 96 // target)
    if target < stride:
        times = stride // target
        assert torch.equal(resized[:, :, times // 2 :: times, times // 2 :: times], features)


@pytest.mark.parametrize("variant", ["l", "s"])
def test_an_untrained_network_predicts_no_drogue_and_boxes_of_four_strides(variant: str) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(6)
        torch_network = DetectorNetwork(NetworkConfig(variant)).train()
    images = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(6))
    with torch.no_grad():
        maps = torch_network(images)
    # Weights of 0.01 on 64 to 96 normalised features move the bias by about 0.1.
    for each in maps:
        assert float((each[:, 0].sigmoid() - 0.01).abs().max()) < 0.01
        assert float((each[:, 1:].exp() - 2).abs().max()) < 1.0


def test_depthwise_convolution_in_autocast_is_the_float32_one_where_bf16_is_slow() -> None:
    features = torch.randn(2, 16, 12, 14, generator=torch.Generator().manual_seed(7))
    for kernel, stride in ((5, 1), (3, 2), (5, 2)):
        layer = DepthwiseConv(16, kernel, stride)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            output = layer(features)
        assert output.dtype == torch.bfloat16
        # Rounded once, after sums in float32: half a step of 8 bits, 2^-9 of the number.
        torch.testing.assert_close(output.float(), layer(features), rtol=2**-8, atol=1e-5)


def test_autocast_outputs_are_float32_and_nearly_the_same() -> None:
    torch_network = make_network(NetworkConfig("s"))
    images = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(8))
    with torch.no_grad():
        exact = torch_network(images)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            outputs = torch_network(images)
    for output, reference in zip(outputs, exact, strict=True):
        assert output.dtype == torch.float32
        # Some 60 layers that round to 2^-9 each, relative to the spread of the outputs.
        assert float((output - reference).abs().mean() / reference.std()) < 0.1


def test_complexity_of_layers_worked_by_hand() -> None:
    # 3x3 from 3 to 8 channels at stride 2, depthwise 5x5, 1x1 from 8 to 4; 12x10 images.
    layers = nn.Sequential(
        nn.Conv2d(3, 8, 3, 2, 1), nn.Conv2d(8, 8, 5, padding=2, groups=8, bias=False), nn.Conv2d(8, 4, 1)
    )
    found = complexity(layers, (12, 10))
    cells = 6 * 5
    assert found.multiply_adds == cells * (8 * 3 * 9 + 8 * 25 + 4 * 8)
    assert found.parameters == (8 * 27 + 8) + 8 * 25 + (32 + 4)
    assert found.gflops == pytest.approx(2 * found.multiply_adds / 1e9)


def test_the_documented_sizes_are_right() -> None:
    page = (Path(__file__).resolve().parents[4] / "docs/explanation/detector-network.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([ls])` (\w+) (\w+) \| ([\d,]+) \| ([\d.]+) \| ([\d.]+) \|$", page, re.MULTILINE)
    assert rows
    for variant, attention, fusion, parameters, *gflops in rows:
        config = NetworkConfig.from_dict({"variant": variant, "attention": attention, "fusion": fusion})
        built = DetectorNetwork(config)
        small, large = complexity(built, (64, 64)), complexity(built, (128, 64))
        assert f"{small.parameters:,}" == parameters
        # Attention has a constant part; all else grows with the area, so two small images determine any other.
        per_pixel = (large.gflops - small.gflops) / (64 * 64)
        for area, stated in zip((640 * 480, 640 * 640), gflops, strict=True):
            assert f"{small.gflops + per_pixel * (area - 64 * 64):.2f}" == stated


def test_complexity_does_not_change_the_network() -> None:
    torch_network = DetectorNetwork(NetworkConfig("s")).train()
    before = {name: value.clone() for name, value in torch_network.state_dict().items()}
    small, large = (complexity(torch_network, size).multiply_adds for size in ((96, 64), (192, 128)))
    # Everything but the attention's convolution over channels (17 numbers in all) grows with the image.
    assert large == pytest.approx(4 * small, rel=1e-3)
    assert torch_network.training
    assert all(torch.equal(value, before[name]) for name, value in torch_network.state_dict().items())


def test_the_gain_of_images_can_be_folded_into_the_first_layer() -> None:
    folded = make_network(NetworkConfig("s")).eval()
    images = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        before = folded(images)
        folded.fold_gain()
        after = folded(images)
    # A power of two moves exponents only, so that no sum is rounded in another way; padding by zeros stays zero.
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert folded.gain == 1


@pytest.mark.parametrize(("start", "own", "other"), [("equal", 1 / 3, 1 / 3), ("own", 0.8, 0.1)])
def test_fusion_starts_with_the_same_weights_everywhere(start: FusionStart, own: float, other: float) -> None:
    network = make_network(NetworkConfig("s"))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.initialize_fusion(start)
    generator = torch.Generator().manual_seed(9)
    for level, fusion in enumerate(network.neck.fuse):
        assert isinstance(fusion, AdaptiveFusion)
        channels = network.heads[level].score.in_channels
        levels = [3 * torch.randn(1, channels, 4, 6, generator=generator) for _ in STRIDES]
        wanted = torch.full((1, 3, 4, 6), other)
        wanted[:, level] = own
        torch.testing.assert_close(fusion.level_weights(levels), wanted, rtol=0, atol=1e-6)
    changed = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    assert changed and all("weigh" in name for name in changed)


def test_the_scale_of_filters_before_normalisation_does_not_change_what_a_network_computes() -> None:
    networks = []
    for sd in (0.1, 0.2):
        network = make_network(NetworkConfig("s")).train()
        with torch.random.fork_rng():
            torch.manual_seed(8)
            network.initialize_filters(sd)
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eps = 1e-12  # it has to be above 0
        networks.append(network)
    filters = [
        [each.weight.detach() for each in network.modules() if isinstance(each, nn.Conv2d) and each.bias is None]
        for network in networks
    ]
    every = torch.cat([each.flatten() for each in filters[0]])
    # Of some 500,000 independent normal values the standard deviation is known to 0.1 %.
    assert float(every.std()) == pytest.approx(0.1, rel=0.005)
    for one, other in zip(*filters, strict=True):
        torch.testing.assert_close(2 * one, other)
    images = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(8))
    with torch.no_grad():
        small, large = (network(images) for network in networks)
    # A factor of two moves exponents only, but products are not summed in one order by all kernels.
    for one, other in zip(small, large, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_networks_start_with_the_score_that_they_are_given() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(6)
        network = DetectorNetwork(NetworkConfig("s")).train()
    network.initialize_scores(0.2)
    with torch.no_grad():
        maps = network(torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(6)))
    # Weights of 0.01 on 64 normalised features move the logit by about 0.1, at most by some standard deviations.
    for each in maps:
        assert float((each[:, 0].sigmoid() - 0.2).abs().max()) < 0.1
