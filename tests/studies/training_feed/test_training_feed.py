"""The measurement of waiting, on pairs that render quickly."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from droguekit.torch import RenderStream
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from studies.training_feed.__main__ import HEIGHT_PX, WIDTH_PX, Feed, feed_recipe, left_and_right, measure_epoch
from tests.support.recipe_builder import RIG_160_PX, build_recipe
from tests.support.small_datasets import SINGLE_PAIRS

# The network takes multiples of 32 pixels.
RIG = RIG_160_PX | {"height_px": 128}


def test_an_epoch_is_timed_without_its_first_step(tmp_path: Path) -> None:
    recipe = build_recipe(SINGLE_PAIRS, rig=RIG, seed=3, frames={"count": 3, "scenes": 3})
    stream = RenderStream(recipe, tmp_path / "cache", replays=1, transform=left_and_right)
    network = DetectorNetwork(NetworkConfig("s")).train()
    before = [each.detach().clone() for each in network.parameters()]
    feed = measure_epoch(stream, 2, network, workers=0)
    assert feed.steps == 2
    assert feed.start_s > 0
    assert 0 < feed.fed_fraction < 1
    assert any(not torch.equal(old, new) for old, new in zip(before, network.parameters(), strict=True))


def test_the_share_is_that_of_the_times() -> None:
    feed = Feed(steps=10, start_s=3.0, waiting_s=1.0, training_s=19.0)
    assert feed.fed_fraction == 0.95
    assert "fed 95.0 % of the time" in feed.line("epoch")


def test_one_step_is_too_short(tmp_path: Path) -> None:
    recipe = build_recipe(SINGLE_PAIRS, rig=RIG, seed=3, frames={"count": 1, "scenes": 1})
    stream = RenderStream(recipe, tmp_path / "cache", transform=left_and_right)
    with pytest.raises(ValueError, match="too short to measure"):
        measure_epoch(stream, 2, DetectorNetwork(NetworkConfig("s")).train(), workers=0)


def test_the_recipe_has_the_networks_size() -> None:
    recipe = feed_recipe(24)
    assert (recipe.rig.camera.height_px, recipe.rig.camera.width_px) == (HEIGHT_PX, WIDTH_PX)
    assert recipe.frames.count == 24
