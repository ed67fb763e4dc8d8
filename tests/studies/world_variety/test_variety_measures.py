"""Variety of drogues, silhouettes and probes on pictures whose answer is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from studies.world_variety.light_sheets import LIGHTS_RECIPE, sheet_rows
from studies.world_variety.variety_measures import (
    CROP_PX,
    distinct_silhouettes,
    embedding,
    measure_variety,
)

SMALL_RIG = {"preset": "rgb-ideal", "width_px": 320, "height_px": 240, "focal_px": 533.3}


def ring(radius_px: int) -> NDArray[np.float32]:
    image = np.zeros((CROP_PX, CROP_PX), dtype=np.float32)
    return np.asarray(cv2.circle(image, (CROP_PX // 2, CROP_PX // 2), radius_px, 1.0, 3), dtype=np.float32)


def square(half_px: int) -> NDArray[np.float32]:
    image = np.zeros((CROP_PX, CROP_PX), dtype=np.float32)
    low, high = CROP_PX // 2 - half_px, CROP_PX // 2 + half_px
    return np.asarray(cv2.rectangle(image, (low, low), (high, high), 1.0, 3), dtype=np.float32)


def test_equal_looks_have_no_distance_and_other_shapes_more_than_a_little_larger_ones() -> None:
    vectors = np.stack([embedding(picture) for picture in (ring(24), ring(24), ring(25), square(22))])
    equal, larger, other = pdist(vectors)[:3]
    assert equal == 0
    assert 0 < larger < other <= np.sqrt(2)


def test_the_embedding_does_not_depend_on_brightness() -> None:
    np.testing.assert_allclose(embedding(0.5 * ring(24)), embedding(ring(24)), atol=1e-3)


def test_a_flat_crop_has_an_embedding_without_direction() -> None:
    assert not embedding(np.zeros((CROP_PX, CROP_PX), dtype=np.float32)).any()


def test_silhouettes_count_once_for_each_shape() -> None:
    tall = np.zeros((48, 48), dtype=bool)
    tall[:, :12] = True
    little_wider = tall.copy()
    little_wider[:, 12:14] = True
    wide = tall.T
    assert distinct_silhouettes([tall, wide, little_wider, tall, wide]) == 2
    assert distinct_silhouettes([]) == 0


def test_a_dataset_of_one_drogue_head_on_has_little_variety_and_no_tanker(tmp_path: Path) -> None:
    recipe = load_recipe(
        str(LIGHTS_RECIPE),
        rig=SMALL_RIG,
        render={"engine": "analytic"},
        frames={"count": 4},
        distance={"law": "stations", "stations_m": [4.0]},
        pose={"roll_deg": [0, 0], "pitch_deg": [0, 0], "yaw_deg": [0, 0]},
    )
    found = measure_variety(render_dataset(recipe, tmp_path / "pairs", workers=0))
    assert (found.pairs, found.drogues, found.tankers, found.silhouettes, found.probes) == (4, 4, 0, 0, 0)
    assert 0 < found.drogue_distance_p10 <= found.drogue_distance < 0.5


def test_a_dataset_without_two_drogues_cannot_be_measured(tmp_path: Path) -> None:
    recipe = load_recipe(str(LIGHTS_RECIPE), rig=SMALL_RIG, render={"engine": "analytic"}, frames={"count": 1})
    with pytest.raises(ValueError, match="has 1 drogues of at least 24 px; needs two"):
        measure_variety(render_dataset(recipe, tmp_path / "pairs", workers=0))


def test_a_sheet_has_sixteen_tiles_for_each_drogue_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    subject = {"red-8": {"rig": SMALL_RIG, "render": {"engine": "analytic"}}}
    rows = sheet_rows(tmp_path, subject, workers=0, whole_image=False)
    height_px, width_px = rows["red-8"].shape[:2]
    assert width_px // 16 == width_px / 16
    tiles = rows["red-8"][26:-4].reshape(height_px - 30, 16, -1, 3)
    assert all(tiles[:, place].std() > 5 for place in range(16))
    again = sheet_rows(tmp_path, subject, workers=0, whole_image=False)
    np.testing.assert_array_equal(again["red-8"], rows["red-8"])
