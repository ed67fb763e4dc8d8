"""Clusters of looks: what is alike is one, what differs is another, and families count their own."""

from __future__ import annotations

import numpy as np

from datasets_manifest.types.environment import Environment, Mist
from studies.realism.scene_variety import HEIGHT_PX, WIDTH_PX, clusters, family_variety, look, surroundings_picture


def even(level: float, top: float = 0.0) -> np.ndarray:
    picture = np.full((HEIGHT_PX, WIDTH_PX, 3), level, dtype=np.float32)
    picture[: HEIGHT_PX // 2] += np.float32(top)
    return picture


def test_alike_pictures_are_one_cluster_and_others_are_not() -> None:
    looks = [look(even(0.5)), look(even(0.51)), look(even(0.5, 0.2)), look(even(0.8))]
    found = clusters(looks)
    assert found[0] == found[1]
    assert len(set(found.tolist())) == 3
    # A lightness that differs everywhere by one unit is a distance of one.
    assert len(set(clusters(looks, 200.0).tolist())) == 1


def test_a_chain_of_small_steps_is_one_cluster() -> None:
    steps = [look(even(0.3 + 0.01 * k)) for k in range(40)]
    assert len(set(clusters(steps).tolist())) == 1
    assert len(set(clusters([steps[0], steps[-1]]).tolist())) == 2


def test_families_count_the_clusters_that_hold_their_scenes() -> None:
    rows = family_variety(["a", "b", "a", "b", "b"], [1, 1, 1, 2, 3])
    assert [tuple(row) for row in rows] == [("a", 2, 1), ("b", 3, 3)]


def test_thick_mist_looks_alike_over_any_ground_and_thin_mist_does_not() -> None:
    values = {
        "sun_elevation_deg": 40.0,
        "sun_azimuth_deg": 150.0,
        "turbidity": 2.5,
        "visibility_m": 60_000.0,
        "altitude_m": 800.0,
        "ground": "sea",
        "ground_texture_seed": 1,
    }

    def seen(visibility_m: float, ground: tuple[float, float, float], reach_m: float) -> np.ndarray:
        mist = Mist(visibility_m=visibility_m, above_m=reach_m, below_m=reach_m)
        made = Environment.model_validate(values | {"mist": mist, "ground_reflectance_rgb": ground})
        return look(surroundings_picture(made))

    dark, bright = (0.02, 0.03, 0.04), (0.2, 0.3, 0.4)
    thick = [seen(100.0, ground, 150.0) for ground in (dark, bright)]
    assert len(set(clusters(thick).tolist())) == 1
    both = [thick[0], seen(8000.0, dark, 5.0)]
    assert len(set(clusters(both).tolist())) == 2
