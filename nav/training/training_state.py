"""Everything that changes while a training runs: its device, its checkpoint to resume from, weights to start from."""

from __future__ import annotations

import copy
import hashlib
import io
import math
import os
import pickle
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor, nn

from datasets_manifest.atomic import PART_SUFFIX, open_bytes_atomic
from drogue_models.untrusted_files import limited_memory, read_regular
from nav.detector.detector_registry import network_file
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from nav.training.corpus import DatasetStamp
from nav.training.onnx_conversion import import_onnx
from nav.training.training_progress import EpochRow
from nav.training.training_settings import TrainingSettings, differing_settings

CHECKPOINT_FILE, BEST_FILE = "checkpoint.pt", "best.pt"
_LOAD_ERRORS = (
    zipfile.BadZipFile, RuntimeError, pickle.UnpicklingError, EOFError, OSError, ValueError, KeyError, AttributeError,
    TypeError, IndexError,
)  # fmt: skip
_VERSION = 3  # incremented with every change of a checkpoint's contents
# After n steps the average spans about the last n/10 of them, until the decay of the settings is reached.
_RAMP_STEPS = 10


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write or replace a file of tensors and plain values, by one rename.

    Raises:
        OSError: the file cannot be written; the previous one stays.
    """
    # torch's own writer reports a full disk as an internal error.
    stream = io.BytesIO()
    torch.save(state, stream)
    with open_bytes_atomic(path) as file:
        file.write(stream.getbuffer())


def load_checkpoint(path: Path, advice: str = "delete it, or train into another folder") -> dict[str, Any] | None:
    """Read a file of `save_checkpoint`; None where there is no such file.

    Args:
        path: of the file.
        advice: what the user can do about a damaged file, for the error message.

    Raises:
        ValueError: the file is truncated, or of another kind; the message names it.
    """
    try:
        content = read_regular(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        # torch stores without compression; a compressed megabyte could hold gigabytes.
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("is compressed")
        # Only tensors and plain values are accepted, so that a file cannot run code.
        with limited_memory(len(content)):
            state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except _LOAD_ERRORS as error:
        raise ValueError(f"{path}: is truncated or not a checkpoint; {advice}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path}: is not a checkpoint; {advice}")
    return state


def remove_partial_files(folder: Path) -> None:
    """Delete the half-written files of a training that was killed."""
    for leftover in folder.glob(f".*{PART_SUFFIX}"):
        if leftover.is_file():
            leftover.unlink()


class MovingAverage:
    """Exponential moving average of a network's weights, which is better than the weights of any step.

    Its batch statistics are measured separately, see `nav.training.evaluation`.

    Attributes:
        network: has the averaged weights; it is never trained.
    """

    def __init__(self, network: DetectorNetwork, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, network: DetectorNetwork, step: int) -> None:
        """Update the average with the weights after a step, counted from 0."""
        decay = min(self._decay, (1 + step) / (_RAMP_STEPS + step))
        averages: list[Tensor] = []
        currents: list[Tensor] = []
        for average, current in zip(self.network.state_dict().values(), network.state_dict().values(), strict=True):
            if average.is_floating_point():
                averages.append(average)
                currents.append(current)
            else:
                average.copy_(current)
        torch._foreach_lerp_(averages, currents, 1 - decay)


@dataclass(frozen=True)
class ComputeDevice:
    """A device, and whether most operations on it use bfloat16."""

    device: torch.device
    bf16: bool

    def autocast(self) -> AbstractContextManager[object]:
        """Context manager in which a network computes with this precision."""
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.bf16)


def open_compute_device(settings: TrainingSettings) -> ComputeDevice:
    """The device and precision of the settings.

    Raises:
        ValueError: the device is not available.
    """
    device = torch.device(settings.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: torch finds no CUDA device; use cpu, or install torch with CUDA")
    if settings.precision != "auto":
        return ComputeDevice(device, settings.precision == "bf16")
    # Without bfloat16 instructions it is emulated, and slower than float32.
    has_bf16 = torch.cuda.is_bf16_supported() if device.type == "cuda" else torch.cpu._is_avx512_bf16_supported()
    return ComputeDevice(device, bool(has_bf16))


@contextmanager
def limit_threads(threads: int) -> Iterator[None]:
    """Let torch compute with this number of threads, or with all available cores for 0, and OpenCV with one."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(threads or len(os.sched_getaffinity(0)))
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


@dataclass(eq=False)
class TrainingState:
    """A training between two steps. Random draws need no state, because they are keyed by the number of the sample.

    Attributes:
        network, average, optimizer: the network, its averaged weights, and its optimizer.
        step: number of steps done.
        losses: total loss of every step.
        parts: (score, box) losses of the steps since the last row.
        rows: results of the epochs done.
        row_seconds: duration of the steps since the last row. [s]
        best: (stage, average precision) of the best weights so far; a stage is an input size.
    """

    network: DetectorNetwork
    average: MovingAverage
    optimizer: torch.optim.Optimizer
    step: int = 0
    losses: list[float] = field(default_factory=list)
    parts: list[tuple[float, float]] = field(default_factory=list)
    rows: list[EpochRow] = field(default_factory=list)
    row_seconds: float = 0.0
    best: tuple[int, float] = (-1, -math.inf)


def new_network(settings: TrainingSettings) -> DetectorNetwork:
    """A network whose random weights follow from the seed."""
    config = NetworkConfig(settings.variant, settings.attention, settings.fusion)
    # torch initialises layers from its global generator, whose state is restored afterwards.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network = DetectorNetwork(config)
        if settings.filter_sd:
            network.initialize_filters(settings.filter_sd)
    network.initialize_scores(settings.prior_score)
    network.initialize_fusion(settings.fusion_start)
    return network


def new_state(network: DetectorNetwork, settings: TrainingSettings, compute: ComputeDevice) -> TrainingState:
    """The state of a network before the first step."""
    network.to(compute.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return TrainingState(network, MovingAverage(network, settings.ema_decay), _new_optimizer(network, settings))


# Coefficients of the quintic iteration by Jordan et al.: singular values come near 1 in five steps.
_NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)
_NEWTON_SCHULZ_STEPS = 5
_MUON_MOMENTUM = 0.95
# The root mean square of AdamW's updates, so that both have the same learning rate and weight decay.
_UPDATE_RMS = 0.2


def orthogonalize(matrix: Tensor) -> Tensor:
    """The matrix with the same singular vectors and singular values near 1, between 0.7 and 1.2.

    Source: Jordan et al. 2024, Muon, https://kellerjordan.github.io/posts/muon, a Newton-Schulz iteration.

    Args:
        matrix: (M, N), not zero.
    """
    is_tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if is_tall else matrix
    x = x / x.norm().clamp(min=1e-12)
    first, third, fifth = _NEWTON_SCHULZ
    for _ in range(_NEWTON_SCHULZ_STEPS):
        gram = x @ x.T
        x = first * x + (third * gram + fifth * gram @ gram) @ x
    orthogonal: Tensor = x.T if is_tall else x
    return orthogonal


class Muon(torch.optim.AdamW):
    """Muon for the matrices of a network, its dense and 1x1 convolutions, and AdamW for everything else.

    Steps of a matrix are orthogonal: as large in directions of small gradients as in those of large ones. They are
    scaled to the size of AdamW's (Liu et al. 2025, arXiv:2502.16982, section 2.2).
    """

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, weight_decay: float) -> None:
        every = list(parameters)
        matrices = [each for each in every if each.ndim > 1 and min(each.flatten(1).shape) > 1 and each.shape[1] > 1]
        taken = {id(each) for each in matrices}
        filters = [each for each in every if each.ndim > 1 and id(each) not in taken]
        others = [each for each in every if each.ndim <= 1]
        groups = [
            {"params": matrices, "weight_decay": weight_decay, "is_orthogonal": True},
            {"params": filters, "weight_decay": weight_decay, "is_orthogonal": False},
            {"params": others, "weight_decay": 0.0, "is_orthogonal": False},
        ]
        super().__init__(groups, lr=learning_rate)

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update all parameters; the gradients of matrices are consumed."""
        for group in self.param_groups:
            if group["is_orthogonal"]:
                for weights in group["params"]:
                    self._step_matrix(weights, group["lr"], group["weight_decay"])
        super().step(closure)

    def _step_matrix(self, weights: nn.Parameter, rate: float, weight_decay: float) -> None:
        gradient, weights.grad = weights.grad, None  # AdamW leaves parameters without a gradient alone
        if gradient is None:
            return
        state = self.state[weights]
        if not state:
            # AdamW wants a count of steps in every state that it loads.
            state["step"], state["momentum"] = torch.zeros(()), torch.zeros_like(weights)
        state["step"] += 1
        mean = state["momentum"]
        mean.lerp_(gradient, 1 - _MUON_MOMENTUM)
        matrix = gradient.lerp(mean, _MUON_MOMENTUM).flatten(1)
        update = orthogonalize(matrix) * (_UPDATE_RMS * max(matrix.shape) ** 0.5)
        weights.mul_(1 - rate * weight_decay)
        weights.sub_(update.reshape(weights.shape), alpha=rate)


def _new_optimizer(network: nn.Module, settings: TrainingSettings) -> torch.optim.Optimizer:
    """The optimizer, with weight decay for filters only, not for biases, and offsets and scales of normalisation."""
    filters = [weights for weights in network.parameters() if weights.ndim > 1]
    others = [weights for weights in network.parameters() if weights.ndim <= 1]
    groups = [{"params": filters, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
    if settings.optimizer == "muon":
        return Muon(network.parameters(), settings.learning_rate, settings.weight_decay)
    if settings.optimizer == "sgd":
        return torch.optim.SGD(groups, lr=settings.learning_rate, momentum=0.9, nesterov=True)
    return torch.optim.AdamW(groups, lr=settings.learning_rate)


def save_state(out: Path, state: TrainingState, settings: TrainingSettings, datasets: Sequence[DatasetStamp]) -> None:
    """Write `checkpoint.pt`, completely or not at all.

    Raises:
        OSError: the file cannot be written; the previous one stays.
    """
    content: dict[str, Any] = {
        "version": _VERSION,
        "settings": settings.model_dump(mode="json"),
        "datasets": [asdict(stamp) for stamp in datasets],
        "network": state.network.state_dict(),
        "average": state.average.network.state_dict(),
        "optimizer": state.optimizer.state_dict(),
        "step": state.step,
        "losses": state.losses,
        "parts": state.parts,
        "rows": [asdict(row) for row in state.rows],
        "row_seconds": state.row_seconds,
        "best": state.best,
    }
    save_checkpoint(out / CHECKPOINT_FILE, content)


def check_settings(out: Path, settings: TrainingSettings) -> None:
    """Check that a training in this folder can be resumed with these settings.

    Raises:
        ValueError: as in `restore_state`, except for the datasets.
    """
    content = load_checkpoint(out / CHECKPOINT_FILE)
    if content is not None:
        _check_same(out / CHECKPOINT_FILE, content, settings, None)


def _check_same(
    path: Path, content: dict[str, Any], settings: TrainingSettings, datasets: Sequence[DatasetStamp] | None
) -> None:
    if content.get("version") != _VERSION:
        raise ValueError(f"{path}: was written by another version of droguekit; train into another folder")
    differing = differing_settings(content.get("settings", {}), settings.model_dump(mode="json"))
    if datasets is not None and content.get("datasets") != [asdict(stamp) for stamp in datasets]:
        differing.append("datasets")
    if differing:
        raise ValueError(
            f"{path}: belongs to a training that differs in {', '.join(differing)}; give the same, or another folder"
        )


def restore_state(
    out: Path, state: TrainingState, settings: TrainingSettings, datasets: Sequence[DatasetStamp]
) -> bool:
    """Load the state that `save_state` wrote into a new one.

    Returns:
        Whether there was a checkpoint.

    Raises:
        ValueError: the checkpoint is truncated, of another version, or of other settings or datasets; the message
            names the file and the differing keys.
    """
    path = out / CHECKPOINT_FILE
    content = load_checkpoint(path)
    if content is None:
        return False
    _check_same(path, content, settings, datasets)
    try:
        state.network.load_state_dict(content["network"])
        state.average.network.load_state_dict(content["average"])
        state.optimizer.load_state_dict(content["optimizer"])
        state.step, state.losses, state.row_seconds = content["step"], content["losses"], content["row_seconds"]
        state.parts, state.rows = content["parts"], [EpochRow(**row) for row in content["rows"]]
        state.best = content["best"]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: does not fit this network; delete it, or train into another folder") from error
    return True


_ADVICE = "give mobile-s, mobile-l, or detector.onnx or best.pt from a training's folder"


@dataclass(frozen=True, eq=False)
class StartingWeights:
    """The weights that a training starts from.

    Attributes:
        path: the file.
        sha256: of its bytes.
        values: every parameter and running mean by its name.
        network: configuration of the network; None where the file does not state it.
    """

    path: Path
    sha256: str
    values: dict[str, torch.Tensor]
    network: NetworkConfig | None = None

    @property
    def need_batch_statistics(self) -> bool:
        """Whether they are from an exported file; `recalibrate_batch_norm` must then follow before training."""
        return self.network is not None

    def load_into(self, network: nn.Module) -> None:
        """Replace all weights of a network.

        Raises:
            ValueError: they are of another network; the message names the file.
        """
        try:
            network.load_state_dict(self.values)
        except RuntimeError as error:
            own = "" if self.network is None else f", {', '.join(self.network.to_dict().values())}"
            raise ValueError(
                f"{self.path}: holds weights of another network{own}; "
                "give variant, attention and fusion as in its training"
            ) from error


def read_starting_weights(name_or_file: str) -> StartingWeights:
    """Read the weights of a shipped network, an exported `*.onnx`, or a training's `best.pt` or `checkpoint.pt`.

    Of a `checkpoint.pt` the averaged weights are taken.

    Raises:
        ValueError: the file is missing, truncated, or holds something else; the message names it.
    """
    path = network_file(name_or_file)
    return _from_checkpoint(Path(name_or_file)) if path is None else _from_onnx(path)


def _from_onnx(path: Path) -> StartingWeights:
    try:
        content = read_regular(path)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: is missing; {_ADVICE}") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        network = import_onnx(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; {_ADVICE}") from error
    return StartingWeights(path, hashlib.sha256(content).hexdigest(), network.state_dict(), network.config)


def _from_checkpoint(path: Path) -> StartingWeights:
    content: dict[str, Any] | None = load_checkpoint(path, _ADVICE)
    if content is None:
        raise ValueError(f"{path}: is missing; {_ADVICE}")
    values = content.get("average", content.get("network"))
    if not isinstance(values, dict) or not all(isinstance(value, torch.Tensor) for value in values.values()):
        raise ValueError(f"{path}: holds no weights; {_ADVICE}")
    return StartingWeights(path, hashlib.sha256(path.read_bytes()).hexdigest(), values)


def starting_network(settings: TrainingSettings, start: StartingWeights | None) -> DetectorNetwork:
    """The network that a training begins with: its weights are random, or those of another training.

    Raises:
        ValueError: the weights do not fit the network.
    """
    network = new_network(settings)
    if start is not None:
        start.load_into(network)
    return network


def settings_from_start(settings: TrainingSettings, start: StartingWeights | None) -> TrainingSettings:
    """The settings, with the hash of the weights that the training starts from.

    Raises:
        ValueError: the settings have the hash of other weights, or need weights to start from.
    """
    given = "" if start is None else start.sha256
    if settings.hard_fraction and start is None:
        raise ValueError("hard_fraction: needs weights to start from, whose failures make pairs hard")
    if settings.start_sha256 not in ("", given):
        raise ValueError(
            f"start_sha256: {settings.start_sha256} is not that of the weights given, {given or 'none'}; "
            "give the file that it names"
        )
    return settings.model_copy(update={"start_sha256": given})
