"""Means and variances of batch normalization, measured for weights that are going to be used.

In training each layer normalizes by its own small batch. The running means that it keeps lag behind weights that
still move, and averaged weights never had batches of their own. So both are measured anew, over many images as they are
in use.
Source: Wu and Johnson 2021, arXiv:2105.07576, section 3 ("precise batch normalization").
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn

from nav.training.corpus import Corpus
from nav.training.precision import Computing
from nav.training.predictions import to_tensor, whole_image
from nav.training.training_settings import SizePx

_MOST_IMAGES = 192  # a mean over as many is known to a twentieth of what images differ by
_BATCH_IMAGES = 16


def measure_batch_statistics(network: nn.Module, corpus: Corpus, size_px: SizePx, computing: Computing) -> None:
    """Replace a network's running means and variances by those over images of the split train.

    Args:
        network: in evaluation mode, and left so.
        corpus: whose images.
        size_px: (height, width) of the network's input.
        computing: where and how.
    """
    layers = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [layer.momentum for layer in layers]
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None  # the plain mean over all batches
        layer.train()
    try:
        for images in statistics_batches(corpus, size_px, computing):
            with torch.inference_mode(), computing.autocast():
                network(images)
    finally:
        for layer, momentum in zip(layers, momenta, strict=True):
            layer.momentum = momentum
            layer.eval()


def statistics_batches(corpus: Corpus, size_px: SizePx, computing: Computing) -> Iterator[Tensor]:
    """(B, 3, H, W) images of the split train, evenly over all datasets and scenes."""
    members = [(int(pair), eye) for pair in corpus.split("train") for eye in (0, 1)]
    chosen = np.linspace(0, len(members) - 1, min(_MOST_IMAGES, len(members))).astype(int)
    batches = -(-len(chosen) // _BATCH_IMAGES)
    # Each batch takes images from everywhere: the variance between scenes belongs to it.
    for first in range(batches):
        group = [members[i] for i in chosen[first::batches]]
        images = np.stack([whole_image(corpus, pair, eye, size_px)[0] for pair, eye in group])
        yield to_tensor(images, computing)
