from __future__ import annotations

import errno
import resource
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from nav.training.corpus import Corpus
from nav.training.evaluation import average_precision, best_threshold, measure_batch_statistics, to_tensor, whole_image
from nav.training.trainer import learning_rate
from nav.training.training_settings import TrainingSettings, build_settings, parse_size
from nav.training.training_state import ComputeDevice, MovingAverage, load_checkpoint, new_network, save_checkpoint

NONE = (np.zeros((0, 4)), np.zeros(0))
BOX = np.array([[10.0, 10.0, 20.0, 20.0]])


def found(score: float, shift_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return BOX + np.array([shift_px, 0, 0, 0]), np.array([score])


def test_average_precision_of_cases_that_are_worked_by_hand() -> None:
    empty = np.zeros((0, 4))
    perfect = average_precision([BOX, BOX], [found(0.9), found(0.8)])
    assert perfect is not None and (perfect.ap, perfect.ap50, perfect.recall50) == (1.0, 1.0, 1.0)
    half = average_precision([BOX, BOX], [found(0.9), NONE])
    # 51 of COCO's 101 recall levels lie at or below one half.
    assert half is not None and half.ap50 == pytest.approx(51 / 101) and half.recall50 == 0.5
    alarm = average_precision([BOX, empty], [found(0.5), found(0.9)])
    assert alarm is not None and alarm.ap50 == pytest.approx(0.5)  # every level at a precision of 1 in 2
    # Shifted by 4 of 20 px the overlap is 16 / 24 = 0.67: right at 0.5, 0.55, 0.6 and 0.65.
    shifted = average_precision([BOX], [found(0.9, 4.0)])
    assert shifted is not None and (shifted.ap50, shifted.ap75, shifted.ap) == pytest.approx((1.0, 0.0, 0.4))
    nothing = average_precision([BOX], [NONE])
    assert nothing is not None and nothing.ap50 == 0.0
    assert average_precision([empty], [found(0.9)]) is None


def test_the_threshold_parts_right_answers_from_wrong_ones() -> None:
    empty = np.zeros((0, 4))
    truth = [BOX, BOX, empty, empty]
    assert best_threshold(truth, [found(0.9), found(0.7), found(0.5), NONE], 0.1) == pytest.approx(0.6)
    # An answer beside the drogue is wrong.
    assert best_threshold(truth, [found(0.9), found(0.7, 15.0), NONE, NONE], 0.1) == pytest.approx(0.8)
    assert best_threshold(truth, [NONE] * 4, 0.1) == 0.1


def test_the_threshold_lies_in_the_middle_of_those_that_chance_does_not_tell_apart() -> None:
    empty = np.zeros((0, 4))
    # Nine drogues are found, then wrong and right answers come in turns, and one drogue is missed. From the eighth
    # answer on, four or five of all are wrong or missing.
    right = [0.99 - 0.01 * k for k in range(9)]
    mixed = [(0.8, False), (0.7, True), (0.6, False), (0.5, True), (0.4, False), (0.3, True), (0.2, False)]
    truth = [BOX] * 9 + [BOX if is_right else empty for _, is_right in mixed] + [BOX]
    answers = [found(score) for score in right] + [found(score) for score, _ in mixed] + [NONE]
    # As many images without a drogue as with one, thirteen each.
    even = truth + [empty] * 9, answers + [NONE] * 9
    assert best_threshold(*even, 0.1) == pytest.approx(right[7] / 2)
    # With four, each answer in one of them counts for 13 / 4: those from the first on are worse than but for chance.
    assert best_threshold(truth, answers, 0.1) == pytest.approx((right[7] + 0.8) / 2)


def test_the_learning_rate_rises_then_falls_by_a_cosine() -> None:
    settings = TrainingSettings(
        image_passes=8800, batch_images=8, warmup_passes=800, learning_rate=0.5, floor_fraction=0.02
    )
    rates = np.array([learning_rate(settings, step) for step in range(settings.steps + 1)])
    assert (np.diff(rates[:101]) > 0).all() and (np.diff(rates[100:]) < 0).all()
    assert rates[100] == pytest.approx(0.5) and rates[-1] == pytest.approx(0.01)
    assert rates[600] == pytest.approx(0.5 * 1.02 / 2)  # the middle of the cosine: half way between top and floor


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


def test_batch_statistics_are_those_of_one_pass_over_all_images(ellipse_corpus: Corpus) -> None:
    size_px, compute = (64, 96), ComputeDevice(torch.device("cpu"), bf16=False)
    network = new_network(TrainingSettings(variant="s")).eval()
    weights = {name: value.clone() for name, value in network.named_parameters()}
    momenta = [layer.momentum for layer in normalizations(network)]
    measure_batch_statistics(network, ellipse_corpus, size_px, compute)
    first = {name: value.clone() for name, value in network.state_dict().items()}
    # The input of the first one does not depend on any before it.
    images = np.stack([whole_image(ellipse_corpus, pair, eye, size_px)[0] for pair in range(12) for eye in (0, 1)])
    seen: list[tuple[torch.nn.Module, torch.Tensor]] = []
    hooks = [
        layer.register_forward_pre_hook(lambda layer, inputs: seen.append((layer, inputs[0])))
        for layer in normalizations(network)
    ]
    with torch.no_grad():
        network(to_tensor(images, compute))
    for hook in hooks:
        hook.remove()
    layer, values = seen[0]
    # The batches, of every second image, weigh equally. Each sums 18,432 numbers in float32, one after another: up to
    # so many roundings of 6e-8, which are alike where the images are plain black.
    torch.testing.assert_close(layer.running_mean, values.mean(dim=(0, 2, 3)), rtol=1e-3, atol=1e-4)
    within = torch.stack([batch.var(dim=(0, 2, 3)) for batch in (values[::2], values[1::2])]).mean(dim=0)
    torch.testing.assert_close(layer.running_var, within, rtol=1e-3, atol=1e-4)
    measure_batch_statistics(network, ellipse_corpus, size_px, compute)
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, first[name], rtol=1e-5, atol=1e-6)
    assert all(torch.equal(value, weights[name]) for name, value in network.named_parameters())
    assert [layer.momentum for layer in normalizations(network)] == momenta
    assert not any(module.training for module in network.modules())


def normalizations(network: torch.nn.Module) -> list[torch.nn.BatchNorm2d]:
    return [module for module in network.modules() if isinstance(module, torch.nn.BatchNorm2d)]


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size_px": (480, 650)}, "size_px: must be multiples of 32 px"),
        ({"size_px": (0, 640)}, "size_px: must be multiples of 32 px"),
        ({"size_px": (4128, 640)}, "size_px: must be at most 4096 px a side, got 4128x640"),
        ({"final_size_px": (480, 320_000)}, "final_size_px: must be at most 4096 px a side"),
        ({"batch_images": 5}, "batch_images: must be even"),
        ({"batch_images": 2048}, "batch_images:"),
        ({"loader_threads": 65}, "loader_threads:"),
        ({"variant": "m"}, "variant:"),
        ({"learning_rate": float("nan")}, "learning_rate:"),
        ({"image_passes": 0}, "image_passes:"),
        ({"colour": 1}, "colour:"),
    ],
)
def test_wrong_settings_are_one_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        build_settings(None, changes)
    assert "\n" not in str(caught.value)


def test_settings_come_from_a_file_and_changes_go_before_it(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('variant = "s"\nlearning_rate = 0.002\nsize_px = [320, 416]\n')
    settings = build_settings(file, {"learning_rate": 0.004})
    assert (settings.variant, settings.learning_rate, settings.size_px) == ("s", 0.004, (320, 416))
    file.write_text("variant = \n")
    with pytest.raises(ValueError, match=r"mine\.toml: is not TOML"):
        build_settings(file, {})
    with pytest.raises(ValueError, match=r"none\.toml: cannot be read"):
        build_settings(tmp_path / "none.toml", {})


def test_sizes_are_height_by_width() -> None:
    assert parse_size("480x640") == (480, 640)
    for text in ("480", "x640", "480x-32", "480 x 640", "a" * 50):
        with pytest.raises(ValueError, match="must be HEIGHTxWIDTH"):
            parse_size(text)
