"""Pairs in which the weights at the start fail, and how often a training shows them."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from droguekit.batch.progress import PlainProgress
from nav.training.corpus import Corpus, ImageCache, open_corpus
from nav.training.hard_pairs import HARD_PAIRS_FILE, hard_pairs, is_failure
from nav.training.trainer import BatchMaker, Member
from nav.training.training_run import train
from nav.training.training_settings import TrainingSettings, build_settings
from nav.training.training_state import (
    ComputeDevice,
    StartingWeights,
    new_network,
    read_starting_weights,
    save_checkpoint,
)

QUIET = PlainProgress(io.StringIO())
CPU = ComputeDevice(torch.device("cpu"), bf16=False)
DROGUE, BESIDE, ELSEWHERE = (10.0, 10.0, 20.0, 20.0), (14.0, 10.0, 20.0, 20.0), (60.0, 10.0, 20.0, 20.0)
SMALL = (60.0, 10.0, 4.0, 5.0)


@pytest.mark.parametrize(
    ("truth", "found", "fails"),
    [
        ([], [], False),
        ([DROGUE], [(DROGUE, 0.5)], False),
        ([DROGUE], [(BESIDE, 0.9)], False),  # an overlap of 2/3
        ([DROGUE], [(DROGUE, 0.9), (ELSEWHERE, 0.49)], False),
        ([DROGUE, SMALL], [(DROGUE, 0.9)], False),
        ([DROGUE, SMALL], [(DROGUE, 0.9), (SMALL, 0.9)], False),
        ([DROGUE], [], True),
        ([DROGUE], [(DROGUE, 0.49)], True),
        ([DROGUE], [(DROGUE, 0.9), (ELSEWHERE, 0.5)], True),
        ([DROGUE, ELSEWHERE], [(DROGUE, 0.9)], True),
        ([], [(ELSEWHERE, 0.5)], True),
    ],
)
def test_a_missed_drogue_and_a_box_on_none_are_failures(
    truth: list[tuple[float, ...]], found: list[tuple[tuple[float, ...], float]], fails: bool
) -> None:
    boxes = np.array([box for box, _ in found]).reshape(-1, 4)
    assert is_failure(np.array(truth).reshape(-1, 4), boxes, np.array([score for _, score in found]), 8.0) is fails


def settings_with(**changes: object) -> TrainingSettings:
    return build_settings(None, {"size_px": (96, 128), "batch_images": 4, "image_passes": 480, **changes})


def half_without_drogue(corpus: Corpus) -> Corpus:
    """The plain corpus in which every second pair shows no drogue."""
    (cache,) = corpus.caches
    pairs = tuple(
        pair.model_copy(update={"boxes": (None, None)}) if pair.frame_index % 2 else pair for pair in cache.pairs
    )
    return replace(corpus, caches=(ImageCache(cache.images, pairs, cache.faults, cache.opacities),))


def random_start(folder: Path, settings: TrainingSettings) -> StartingWeights:
    """Weights before any training, which find nothing."""
    save_checkpoint(folder / "random.pt", {"network": new_network(settings).state_dict()})
    return read_starting_weights(str(folder / "random.pt"))


def test_a_network_that_finds_nothing_fails_where_there_are_drogues(ellipse_corpus: Corpus, tmp_path: Path) -> None:
    corpus, settings = half_without_drogue(ellipse_corpus), settings_with(variant="s")
    start = random_start(tmp_path, settings)

    def found(settings: TrainingSettings = settings, start: StartingWeights = start) -> list[int]:
        pairs: list[int] = hard_pairs(tmp_path, start, corpus, settings, CPU, QUIET).tolist()
        return pairs

    every = [0, 2, 4, 6, 8, 10]
    assert found() == every
    # A training that resumes reads them, as long as it is the same search.
    listed = json.loads((tmp_path / HARD_PAIRS_FILE).read_text())
    assert listed["pairs"] == every and listed["size_px"] == [96, 128]
    fewer = json.dumps(listed | {"pairs": [4]})
    (tmp_path / HARD_PAIRS_FILE).write_text(fewer)
    assert found() == [4]
    assert found(start=replace(start, sha256="0" * 64)) == every
    (tmp_path / HARD_PAIRS_FILE).write_text(fewer)
    assert found(settings.model_copy(update={"size_px": (64, 96)})) == every
    for damaged in (
        fewer[:-3],
        "[4]",
        json.dumps(listed | {"pairs": [1e999]}),
        json.dumps(listed | {"pairs": "four"}),
        json.dumps(listed | {"pairs": [12]}),
    ):
        (tmp_path / HARD_PAIRS_FILE).write_text(damaged)
        assert found() == every


def test_hard_pairs_stay_the_same_where_another_pair_is_left_out(ellipse_corpus: Corpus, tmp_path: Path) -> None:
    (cache,), settings = half_without_drogue(ellipse_corpus).caches, settings_with(variant="s")
    pairs = (cache.pairs[0].model_copy(update={"split": "val"}), *cache.pairs[1:])
    whole = replace(ellipse_corpus, caches=(replace(cache, pairs=pairs),))
    start, left_out = random_start(tmp_path, settings), replace(whole, places=whole.places[1:])
    assert hard_pairs(tmp_path, start, whole, settings, CPU, QUIET).tolist() == [2, 4, 6, 8, 10]
    assert hard_pairs(tmp_path, start, left_out, settings, CPU, QUIET).tolist() == [1, 3, 5, 7, 9]


def test_an_exported_network_is_searched_with_as_it_is(toy_dataset: Path, tmp_path: Path) -> None:
    settings = settings_with(variant="s", size_px=(224, 320))
    corpus = open_corpus([toy_dataset], tmp_path / "cache", (224, 320), 1, QUIET)
    hard = hard_pairs(tmp_path, read_starting_weights("mobile-s"), corpus, settings, CPU, QUIET)
    # Rings before a plain sky, which the network that ships finds nearly all.
    assert len(hard) < len(corpus.split("train")) / 4


def test_a_search_that_is_interrupted_leaves_no_list(ellipse_corpus: Corpus, tmp_path: Path) -> None:
    settings = settings_with(variant="s")
    start = random_start(tmp_path, settings)
    with pytest.raises(KeyboardInterrupt):
        hard_pairs(tmp_path, start, ellipse_corpus, settings, CPU, QUIET, lambda: True)
    assert not (tmp_path / HARD_PAIRS_FILE).exists()


@pytest.mark.parametrize("views", ["one", "both"])
def test_so_many_images_are_of_hard_pairs(ellipse_corpus: Corpus, views: str) -> None:
    shown: list[int] = []

    class Watched(BatchMaker):
        def _members(self, sample: int) -> list[Member]:
            members = super()._members(sample)
            shown.extend(member.pair for member in members)
            return members

    settings = settings_with(views=views, mosaic=False, hard_fraction=0.4)
    maker = Watched(ellipse_corpus, settings, np.array([3, 7]))
    for step in range(120):
        maker.batch(step)
    hard = np.isin(shown, [3, 7]).sum()
    # Two of twelve pairs, and two fifths of the others' places: binomial, four standard deviations either way.
    share, samples = 0.4 + 0.6 * 2 / 12, len(shown) / (2 if views == "both" else 1)
    assert abs(hard / len(shown) - share) < 4 * np.sqrt(share * (1 - share) / samples)
    assert set(shown) == set(range(12))


def test_without_hard_pairs_all_batches_are_as_before(ellipse_corpus: Corpus) -> None:
    plain = BatchMaker(ellipse_corpus, settings_with()).batch(3)
    none = BatchMaker(ellipse_corpus, settings_with(hard_fraction=0.5), np.zeros(0, np.int64)).batch(3)
    np.testing.assert_array_equal(plain.images, none.images)


@pytest.mark.slow
def test_a_training_that_is_stopped_goes_on_with_the_same_hard_pairs(split_dataset: Path, tmp_path: Path) -> None:
    told = io.StringIO()
    settings = settings_with(variant="s", image_passes=16, hard_fraction=0.5, precision="float32", threads=1)
    with pytest.raises(ValueError, match="hard_fraction: needs weights to start from"):
        train([split_dataset], tmp_path / "none", settings, PlainProgress(told))
    assert not (tmp_path / "none").exists()
    start, whole, stopped = random_start(tmp_path, settings), tmp_path / "whole", tmp_path / "stopped"
    train([split_dataset], whole, settings, PlainProgress(told), start=start)
    assert "the weights at the start fail in 4 of 4 pairs to train on" in told.getvalue()
    calls = iter(range(100))
    with pytest.raises(KeyboardInterrupt):
        # After eight pairs that are decoded and two batches that are searched, it is asked once a step.
        train([split_dataset], stopped, settings, PlainProgress(told), None, lambda: next(calls) == 11, start)
    assert 0 < len((stopped / "losses.csv").read_text().splitlines()) - 1 < settings.steps
    train([split_dataset], stopped, settings, PlainProgress(told), start=start)
    mine, undisturbed = (np.loadtxt(out / "losses.csv", delimiter=",", skiprows=1) for out in (stopped, whole))
    # Equal sums in equal order, but for how memory happens to be aligned.
    np.testing.assert_allclose(mine, undisturbed, rtol=1e-4)
