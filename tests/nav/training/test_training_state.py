from __future__ import annotations

import errno
import io
import resource
import signal
import zipfile
from pathlib import Path

import pytest
import torch

from nav.training.training_settings import TrainingSettings
from nav.training.training_state import MovingAverage, load_checkpoint, new_network, save_checkpoint


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
