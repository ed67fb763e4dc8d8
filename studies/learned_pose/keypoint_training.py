"""Training of the SimCC network on augmented crops, and its use."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from datasets_manifest.atomic import write_bytes_atomic
from datasets_manifest.random_streams import sample_generator
from geometry.se3 import Array
from nav.detector.input_image import network_input
from studies.learned_pose.keypoint_corpus import KeypointCorpus
from studies.learned_pose.keypoint_crops import CropView, build_crop, crop_from_patch, map_points, sample_view
from studies.learned_pose.keypoint_network import KeypointNetwork, simcc_loss
from studies.learned_pose.ring_keypoints import clockwise_from_top
from studies.learned_pose.simcc import Decoded, decode, encode

Images = NDArray[np.float32]

_WARM_UP_FRACTION, _LARGEST_GRADIENT = 0.05, 5.0
_WEIGHT_DECAY = 1e-2
_STEPS_PER_CHECKPOINT = 100


@dataclass(frozen=True)
class SimccTraining:
    """Options of the training.

    Attributes:
        image_passes: crops that go through the network.
        batch: crops in a step.
        learning_rate: largest one.
        threads: that it may use.
        seed: of weights, order and augmentation.
    """

    image_passes: int
    batch: int = 16
    learning_rate: float = 2e-3
    threads: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.image_passes, self.batch, self.threads) < 1 or not self.learning_rate > 0 or self.seed < 0:
            raise ValueError(f"training: numbers must be positive, got {self}")

    @property
    def steps(self) -> int:
        """Number of steps."""
        return math.ceil(self.image_passes / self.batch)

    def learning_rate_at(self, step: int) -> float:
        """A linear warm-up, then half a cosine down to zero."""
        warm_up = max(1, round(_WARM_UP_FRACTION * self.steps))
        if step < warm_up:
            return self.learning_rate * (step + 1) / warm_up
        return self.learning_rate * (1 + math.cos(math.pi * (step - warm_up) / max(1, self.steps - warm_up))) / 2


class SimccKeypoints:
    """A trained network."""

    def __init__(self, network: KeypointNetwork) -> None:
        self._network = network.eval()

    @staticmethod
    def load(file: Path) -> SimccKeypoints:
        """The network of a file that `train_simcc` wrote.

        Raises:
            OSError: it cannot be read.
        """
        state = torch.load(io.BytesIO(file.read_bytes()), weights_only=True)
        network = KeypointNetwork(state["keypoints"])
        network.load_state_dict(state["network"])
        return SimccKeypoints(network)

    def keypoints(self, crops: Sequence[NDArray[np.uint8]]) -> list[Decoded]:
        """Keypoints of every crop (CROP_PX, CROP_PX, 3), at least one."""
        with torch.inference_mode():
            logits = self._network(torch.from_numpy(network_input(crops))).numpy()
        return [decode(one) for one in logits]


def training_batch(corpus: KeypointCorpus, training: SimccTraining, step: int) -> tuple[Images, Images]:
    """Augmented crops (B, 3, CROP_PX, CROP_PX) and target distributions (B, 2, K, BINS) of a step."""
    order = sample_generator(training.seed, step, 0, "learned pose order")
    crops, targets = [], []
    for place, chosen in enumerate(order.integers(len(corpus), size=training.batch).tolist()):
        rng = sample_generator(training.seed, step, place, "learned pose view")
        view = sample_view(rng)
        crops.append(build_crop(corpus.patches[chosen], view, rng))
        targets.append(encode(ordered_keypoints(corpus.markers_px[chosen], view)))
    return network_input(crops), np.stack(targets)


def ordered_keypoints(markers_px: Array, view: CropView) -> Array:
    """(N, 2) markers of a patch in a crop, clockwise from the top of the crop. [px of the crop]"""
    points = map_points(crop_from_patch(view), markers_px)
    ordered: Array = points[clockwise_from_top(points)]
    return ordered


def train_simcc(
    load: Callable[[], KeypointCorpus], out: Path, training: SimccTraining, say: Callable[[str], None]
) -> SimccKeypoints:
    """Train a network, or go on with or load the one in a folder.

    Args:
        load: gives the corpus to train on; not called where the training is complete.
        out: folder; `network.pt` is the result, `checkpoint.pt` that of a stopped run.
        training: options.
        say: receives lines about the progress.

    Raises:
        ValueError: the folder holds a training with other options.
        OSError: a file cannot be written.
    """
    result = out / "network.pt"
    if result.exists():
        return SimccKeypoints.load(result)
    corpus = load()
    torch.set_num_threads(training.threads)
    torch.manual_seed(training.seed)
    network = KeypointNetwork(corpus.markers_px.shape[1])
    optimizer = torch.optim.AdamW(network.parameters(), lr=training.learning_rate, weight_decay=_WEIGHT_DECAY)
    first = _resume(out / "checkpoint.pt", network, optimizer, training)
    recent: list[float] = []
    for step in range(first, training.steps):
        network.train()
        for group in optimizer.param_groups:
            group["lr"] = training.learning_rate_at(step)
        crops, targets = training_batch(corpus, training, step)
        loss = simcc_loss(network(torch.from_numpy(crops)), torch.from_numpy(targets))
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
        optimizer.step()
        recent.append(float(loss.detach()))
        if (step + 1) % _STEPS_PER_CHECKPOINT == 0:
            _save(out / "checkpoint.pt", network, training, step=step + 1, optimizer=optimizer.state_dict())
            say(f"step {step + 1} of {training.steps}: loss {np.mean(recent[-_STEPS_PER_CHECKPOINT:]):.3f}")
    _save(result, network, training)
    return SimccKeypoints.load(result)


def _resume(file: Path, network: KeypointNetwork, optimizer: torch.optim.Optimizer, training: SimccTraining) -> int:
    """The step to go on with."""
    if not file.exists():
        return 0
    state = torch.load(io.BytesIO(file.read_bytes()), weights_only=True)
    if state["training"] != asdict(training):
        raise ValueError(f"{file}: is of a training with other options, {state['training']}; name a new folder")
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    return int(state["step"])


def _save(file: Path, network: KeypointNetwork, training: SimccTraining, **more: Any) -> None:
    stream = io.BytesIO()
    keypoints = network.maps[1].out_channels
    state = {"network": network.state_dict(), "training": asdict(training), "keypoints": keypoints, **more}
    torch.save(state, stream)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_bytes_atomic(file, stream.getvalue())
