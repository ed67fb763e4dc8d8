"""Poses from arrays, against those that `droguekit navigate` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import droguekit
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.types.estimates import Estimate
from drogue_models.parameters import MarkerCode
from drogue_models.presets import PRESETS
from geometry.stereo import paper_rig
from nav.runner import navigate


def numbers(estimate: Estimate) -> dict[str, Any]:
    """All but the computing times."""
    return estimate.model_dump(mode="json", exclude={"stage_s"})


def test_poses_are_those_of_the_command(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    navigator = droguekit.Navigator(dataset.rig, dataset.drogue)
    expected = list(navigate(BlindDataset(smoke_dataset), ["joint-hub"]))
    found = [navigator.estimate(pair.images, pair.frame_index) for pair in dataset]
    assert [numbers(each) for each in found] == [numbers(each) for each in expected]
    assert any(isinstance(each, droguekit.PoseEstimate) for each in found)


def test_arrays_alone_give_the_same_pose(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    pair = next(each for each in dataset if each.truth is not None)
    assert pair.truth is not None
    images = pair.images
    whole = droguekit.Navigator(dataset.rig, dataset.drogue).estimate(images, 0)
    navigator = droguekit.Navigator(
        dataset.rig, dataset.drogue, encoding=images.encoding, black_level_dn=images.black_level_dn
    )
    alone = navigator(pair.left, pair.right)
    assert isinstance(alone, droguekit.PoseEstimate)
    assert numbers(alone) == numbers(whole)
    assert np.linalg.norm(alone.left_from_drogue.translation_m - pair.truth.translation_m) < 0.05


def test_no_drogue_gives_a_reason(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    empty = np.full_like(dataset[0].left, 90)
    answer = droguekit.Navigator(dataset.rig, dataset.drogue)(empty, empty)
    assert isinstance(answer, droguekit.NoFix)
    assert "no drogue detected" in answer.reason


def test_images_of_another_size_give_a_reason(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    small = np.zeros((24, 32, 3), np.uint8)
    answer = droguekit.Navigator(dataset.rig, dataset.drogue)(small, small)
    assert isinstance(answer, droguekit.NoFix)
    assert "the images are 32x24 px" in answer.reason


def test_images_of_16_bits_are_refused(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    deep = dataset[0].left.astype(np.uint16) * 257
    with pytest.raises(ValueError, match="12 significant bits in the low end of uint16"):
        droguekit.Navigator(dataset.rig, dataset.drogue)(deep, deep)


@pytest.mark.parametrize("tracker", [None, "bernoulli"])
@pytest.mark.parametrize("time_s", [float("nan"), float("inf"), -float("inf")])
def test_a_time_that_is_no_number_is_refused(time_s: float, tracker: str | None, smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    empty = np.full_like(dataset[0].left, 90)
    navigator = droguekit.Navigator(dataset.rig, dataset.drogue, tracker=tracker)
    with pytest.raises(ValueError, match=f"^time_s: must be a finite number, got {time_s}$"):
        navigator(empty, empty, time_s=time_s)
    # The pair does not count.
    assert navigator(empty, empty, time_s=1.0).frame_index == 0


def test_a_refused_index_does_not_count(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    navigator = droguekit.Navigator(dataset.rig, dataset.drogue)
    images = dataset[0].images
    assert navigator.estimate(images, np.int64(3)).frame_index == 3
    with pytest.raises(ValueError, match=r"^frame_index: must not be negative, got -3$"):
        navigator.estimate(images, -3)
    with pytest.raises(TypeError, match="integer"):
        navigator.estimate(images, 1.5)  # type: ignore[arg-type]
    assert navigator.estimate(images).frame_index == 4


def test_blinking_lamps_need_the_time() -> None:
    """Their code is in the time of the pair, and a made-up one tells a wrong roll."""
    code = MarkerCode(slot_s=0.04, patterns=("01111111",))
    blinking = PRESETS["red-8"].model_copy(update={"marker_luminance_cd_m2": 2e4, "marker_code": code})
    navigator = droguekit.Navigator(paper_rig(), blinking, detector="color-blob")
    dark = np.zeros((960, 1280, 3), np.uint8)
    with pytest.raises(ValueError, match=r"^time_s: a drogue whose lamps blink needs the time of the images"):
        navigator(dark, dark)
    assert navigator(dark, dark, time_s=1.0).frame_index == 0


def test_a_black_level_that_8_bits_do_not_reach_is_refused(smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    navigator = droguekit.Navigator(dataset.rig, dataset.drogue, black_level_dn=300)
    shape = dataset[0].left.shape
    with pytest.raises(ValueError, match=r"^black_level_dn: must be from 0 to 255 for uint8 images, got 300$"):
        navigator(np.full(shape, 90, np.uint8), np.full(shape, 90, np.uint8))
    deep = np.full(shape, 900, np.uint16)
    assert navigator(deep, deep).frame_index == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"method": "magic"}, "magic"),
        ({"detector": "magic"}, "detector: must be one of"),
        ({"centroids": "magic"}, "centroids: must be one of own, binary, edge"),
        ({"encoding": "sepia"}, "encoding: must be linear or gamma"),
        ({"tracker": "magic"}, "magic"),
        ({"black_level_dn": float("nan")}, "black_level_dn: must be from 0 to 4095, got nan"),
        ({"black_level_dn": -5.0}, "black_level_dn: must be from 0 to 4095"),
    ],
)
def test_unknown_names_are_refused(wrong: dict[str, Any], message: str, smoke_dataset: Path) -> None:
    dataset = droguekit.open_dataset(smoke_dataset)
    with pytest.raises(ValueError, match=message):
        droguekit.Navigator(dataset.rig, dataset.drogue, **wrong)
