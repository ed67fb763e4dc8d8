from __future__ import annotations

import errno
import io
import resource
import signal
import zipfile
from pathlib import Path

import pytest
import torch
from torch import nn

from nav.training.training_settings import TrainingSettings
from nav.training.training_state import (
    CHECKPOINT_FILE,
    ComputeDevice,
    MovingAverage,
    Muon,
    TrainingState,
    load_checkpoint,
    new_network,
    new_state,
    orthogonalize,
    restore_state,
    save_checkpoint,
    save_state,
)


def test_the_moving_average_takes_in_weights_and_running_means() -> None:
    settings = TrainingSettings(variant="s")
    network = new_network(settings)
    average = MovingAverage(network, decay=0.5)
    start = {name: value.clone() for name, value in network.state_dict().items()}
    with torch.no_grad():
        for value in network.state_dict().values():
            value.add_(1)
    for step in range(20, 23):
        average.update(network, step)
    for name, value in average.network.state_dict().items():
        # After n steps at decay d the distance to a constant is d^n; counters are taken over.
        gone = 1 - 0.5**3 if value.is_floating_point() else 1
        torch.testing.assert_close(value, start[name] + gone, rtol=1e-5, atol=1e-5)  # float32 next to numbers of 1


def test_weights_follow_from_the_seed_and_torchs_generator_is_left_alone() -> None:
    before = torch.random.get_rng_state()
    first, second, other = (new_network(TrainingSettings(variant="s", seed=seed)) for seed in (1, 1, 2))
    assert torch.equal(before, torch.random.get_rng_state())
    pairs = list(zip(first.parameters(), second.parameters(), strict=True))
    assert all(torch.equal(a, b) for a, b in pairs)
    assert not all(torch.equal(a, b) for a, b in zip(first.parameters(), other.parameters(), strict=True))


def test_a_full_disk_leaves_the_checkpoint_before(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"step": 1})
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"checkpoint\.pt: cannot be written") as caught:
            save_checkpoint(path, {"step": 2, "weights": torch.zeros(10_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert caught.value.errno == errno.EFBIG
    assert load_checkpoint(path) == {"step": 1} and [each.name for each in tmp_path.iterdir()] == ["checkpoint.pt"]


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04"])
def test_a_damaged_checkpoint_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.pt: is truncated or not a checkpoint"):
        load_checkpoint(path)
    whole = tmp_path / "whole.pt"
    save_checkpoint(whole, {"weights": torch.zeros(1000)})
    path.write_bytes(whole.read_bytes()[:-500])
    with pytest.raises(ValueError, match=r"checkpoint\.pt: is truncated or not a checkpoint"):
        load_checkpoint(path)


def test_a_compressed_checkpoint_is_refused(tmp_path: Path) -> None:
    """A megabyte of zeros that are compressed would be a tensor of a gigabyte."""
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"weights": torch.zeros(1000)})
    assert load_checkpoint(path) is not None
    stored = zipfile.ZipFile(io.BytesIO(path.read_bytes()))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in stored.namelist():
            packed.writestr(name, stored.read(name))
    with pytest.raises(ValueError, match=r"checkpoint\.pt: is truncated or not a checkpoint"):
        load_checkpoint(path)


@pytest.mark.parametrize("shape", [(12, 40), (40, 12), (16, 16)])
def test_orthogonalisation_keeps_singular_vectors_and_levels_singular_values(shape: tuple[int, int]) -> None:
    matrix = torch.randn(*shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    u, values, vt = torch.linalg.svd(matrix, full_matrices=False)
    matrix = u @ torch.diag(torch.logspace(0, -1.5, len(values), dtype=torch.float64)) @ vt
    turned = u.T @ orthogonalize(matrix) @ vt.T
    levelled = turned.diagonal()
    # The polynomials of Jordan et al. are tuned for speed, not for 1: they end between 0.68 and 1.14.
    assert float(levelled.min()) > 0.65 and float(levelled.max()) < 1.2
    torch.testing.assert_close(turned, torch.diag(levelled), rtol=0, atol=1e-9)
    torch.testing.assert_close(orthogonalize(7 * matrix), orthogonalize(matrix), rtol=1e-9, atol=1e-9)


def test_muon_steps_matrices_by_their_orthogonal_part_and_all_else_as_adamw() -> None:
    generator = torch.Generator().manual_seed(2)
    shapes = {"dense": (8, 4, 3, 3), "depthwise": (8, 1, 3, 3), "attention": (1, 1, 5), "scale": (8,)}
    ours, theirs = (
        {name: torch.nn.Parameter(torch.ones(shape)) for name, shape in shapes.items()} for _ in ("muon", "adamw")
    )
    gradients = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    muon = Muon(ours.values(), learning_rate=0.1, weight_decay=0.02)
    filters, others = [theirs["depthwise"], theirs["attention"]], [theirs["scale"]]
    groups = [{"params": filters, "weight_decay": 0.02}, {"params": others, "weight_decay": 0.0}]
    adamw = torch.optim.AdamW(groups, lr=0.1)
    for parameters in (ours, theirs):
        for name, value in parameters.items():
            value.grad = gradients[name].clone()
    muon.step()
    adamw.step()
    for name in ("depthwise", "attention", "scale"):
        torch.testing.assert_close(ours[name], theirs[name])
    step = (1 - 0.1 * 0.02 - ours["dense"]).detach().flatten(1)
    # 0.2 sqrt(max(M, N)) times singular values near 1.
    sizes = torch.linalg.svdvals(step) / (0.1 * 0.2 * 36**0.5)
    assert float(sizes.min()) > 0.6 and float(sizes.max()) < 1.2
    # Both turn by the gradient: their product is symmetric and positive.
    product = step @ gradients["dense"].flatten(1).T
    torch.testing.assert_close(product, product.T, rtol=0, atol=1e-4)
    assert bool((torch.linalg.eigvalsh((product + product.T) / 2) > 0).all())


def test_a_training_with_muon_resumes_exactly(tmp_path: Path) -> None:
    settings = TrainingSettings(variant="s", optimizer="muon")
    compute = ComputeDevice(torch.device("cpu"), bf16=False)

    def step(state: TrainingState) -> None:
        for number, weights in enumerate(state.network.parameters()):
            weights.grad = torch.sin(weights.detach() + number + state.step)
        state.optimizer.step()
        state.step += 1

    whole = new_state(new_network(settings), settings, compute)
    step(whole)
    save_state(tmp_path, whole, settings, [])
    resumed = new_state(new_network(settings), settings, compute)
    assert restore_state(tmp_path, resumed, settings, [])
    for state in (whole, resumed):
        step(state)
    for one, other in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(one, other)


def filters(network: nn.Module) -> list[nn.Parameter]:
    """The weights of all convolutions before batch normalisation."""
    return [each.weight for each in network.modules() if isinstance(each, nn.Conv2d) and each.bias is None]


@pytest.mark.parametrize("sd", [0.01, 0.03])
def test_the_first_step_changes_every_filter_by_the_rate_over_its_standard_deviation(sd: float) -> None:
    settings = TrainingSettings(variant="s", filter_sd=sd, learning_rate=1e-4, weight_decay=0.0)
    state = new_state(new_network(settings), settings, ComputeDevice(torch.device("cpu"), bf16=False))
    before = [each.detach().clone() for each in filters(state.network)]
    generator = torch.Generator().manual_seed(3)
    for weights in state.network.parameters():
        weights.grad = torch.randn(weights.shape, generator=generator)
    state.optimizer.step()
    for old, new in zip(before, filters(state.network), strict=True):
        # AdamW's first step is the rate, with the gradient's sign. The smallest layer has 144 filters' weights, whose
        # norm is known to 6 % (one standard deviation).
        change = (new.detach() - old).norm() / old.norm()
        assert float(change) == pytest.approx(1e-4 / sd, rel=0.25)


def test_filters_of_he_have_fewer_large_weights_the_more_inputs_they_have() -> None:
    network = new_network(TrainingSettings(variant="s", filter_sd=0.0))
    for weights in filters(network):
        inputs = weights[0].numel()
        # The smallest layer has 144 weights: one standard deviation of their own is 6 %.
        assert float(weights.detach().std()) == pytest.approx((2 / inputs) ** 0.5, rel=0.25)


@pytest.mark.parametrize(
    ("gone", "former", "told"),
    [("filter_sd", {}, "filter_sd"), ("warmup_fraction", {"warmup_passes": 1500}, "warmup_passes, warmup_fraction")],
)
def test_a_checkpoint_of_an_earlier_version_is_refused_in_one_line(
    gone: str, former: dict[str, int], told: str, tmp_path: Path
) -> None:
    settings = TrainingSettings(variant="s")
    state = new_state(new_network(settings), settings, ComputeDevice(torch.device("cpu"), bf16=False))
    save_state(tmp_path, state, settings, [])
    content = load_checkpoint(tmp_path / CHECKPOINT_FILE)
    assert content is not None
    del content["settings"][gone]
    content["settings"].update(former)
    save_checkpoint(tmp_path / CHECKPOINT_FILE, content)
    with pytest.raises(ValueError, match=rf"checkpoint\.pt: belongs to .* differs in {told};") as caught:
        restore_state(tmp_path, state, settings, [])
    assert "\n" not in str(caught.value)
