"""Scores of a detector by the kind of drogue, on pictures without any difficulty."""

from __future__ import annotations

from pathlib import Path

import pytest

from drogue_models.presets import load_drogue
from droguekit.api.recipe_rendering import load_recipe, render_dataset
from studies.world_variety.detection_by_kind import body_kind, drogue_kind, score_by_kind, tanker_kind
from studies.world_variety.light_sheets import LIGHTS_RECIPE


def test_kinds_tell_the_body_and_whether_there_are_markers() -> None:
    names = ("red-8", "basket-strut-markers", "basket-grey", "cone-markers")
    kinds = [body_kind(load_drogue(name)) for name in names]
    assert kinds == ["ring", "basket", "basket, no markers", "cone"]


def test_every_image_counts_for_its_kind_and_a_plain_ring_is_found(tmp_path: Path) -> None:
    recipe = load_recipe(
        str(LIGHTS_RECIPE),
        drogue="red-8",
        render={"engine": "analytic"},
        frames={"count": 3, "scenes": 3, "empty_fraction": 0.34},
        distance={"law": "stations", "stations_m": [6.0]},
    )
    dataset = tmp_path / "pairs"
    pairs = list(render_dataset(recipe, dataset, workers=0))
    shown = sum(pair.record.frame.drogue is not None for pair in pairs)
    rows = {row.kind: row for row in score_by_kind(dataset, "mobile-s", drogue_kind)}
    tankers = list(score_by_kind(dataset, "mobile-s", tanker_kind))
    assert set(rows) == {"ring", "empty", "all"}
    assert 0 < shown < 3
    ring, all_images = rows["ring"], rows["all"]
    assert (ring.images, ring.drogues, ring.recall) == (2 * shown, 2 * shown, 1.0)
    assert all_images.images == 6 and all_images.false_boxes == ring.false_boxes + rows["empty"].false_boxes
    assert rows["empty"].ap50 is None and rows["empty"].recall is None
    # A frame without a drogue has no tanker either.
    assert tankers == [rows["empty"]._replace(kind="no tanker"), ring._replace(kind="wing"), all_images]


def test_a_detector_without_a_threshold_is_refused(tmp_path: Path) -> None:
    recipe = load_recipe(str(LIGHTS_RECIPE), render={"engine": "analytic"}, frames={"count": 1})
    render_dataset(recipe, tmp_path / "pairs", workers=0)
    with pytest.raises(ValueError, match="has no threshold of its own; name a network"):
        next(score_by_kind(tmp_path / "pairs", "color-blob", drogue_kind))
