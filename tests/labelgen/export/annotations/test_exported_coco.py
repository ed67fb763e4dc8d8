"""COCO files, scored by COCO's own evaluation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import ViewRecord
from drogue_models.parameters import even_ring
from drogue_models.parts import FIRST_MARKER_ID, Part
from drogue_models.presets import PRESETS, load_drogue
from geometry.stereo import EYES
from labelgen.export.annotations.coco import DROGUE, HUB, MARKER, coco_header, coco_image_id, write_coco
from labelgen.export.annotations.keypoint_orders import align_keypoint_orders
from labelgen.export.export_log import ExportLog
from labelgen.export.keypoints import clockwise_order, symmetric_orders


@pytest.fixture(scope="module")
def whole_file(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("coco")
    return write_coco(mixed_dataset, folder, ExportLog())[0]


@pytest.fixture
def truth(whole_file: Path) -> COCO:
    """Anew for each test, because COCO's evaluation writes into it."""
    return COCO(str(whole_file))


def average_precision(truth: COCO, results: list[dict], kind: str) -> float:
    """AP by pycocotools with its own settings, and our sigmas for keypoints."""
    score = COCOeval(truth, truth.loadRes([dict(result, score=0.9) for result in results]), kind)
    if kind == "keypoints":
        score.params.kpt_oks_sigmas = np.array(truth.dataset["info"]["droguekit"]["kpt_oks_sigmas"])
    score.evaluate()
    score.accumulate()
    score.summarize()
    return float(score.stats[0])


def results_of(truth: COCO, *keys: str) -> list[dict]:
    """The truth as results."""
    return [{key: annotation[key] for key in ("image_id", "category_id", *keys)} for annotation in truth.anns.values()]


def keypoint_results(truth: COCO, order_of: Callable[..., Any]) -> list[dict]:
    """The truth's keypoints, each drogue's own ones in another order."""
    results = []
    for result in results_of(truth, "keypoints"):
        (annotation,) = (a for a in truth.imgToAnns[result["image_id"]] if a["category_id"] == DROGUE)
        if result["category_id"] == DROGUE:
            points = np.array(result["keypoints"], dtype=float).reshape(-1, 3)
            order = order_of(annotation["droguekit"])
            points[: len(order)] = points[order]
            results.append({**result, "keypoints": points.ravel().tolist()})
    return results


def image_order(extra: dict) -> list[int]:
    return extra["keypoint_order_in_image"]


def test_truth_against_itself_is_perfect(truth: Any) -> None:
    # 1 but for the rounding of precision = tp / (tp + fp + 2e-16).
    assert average_precision(truth, results_of(truth, "bbox"), "bbox") == pytest.approx(1, abs=1e-12)
    assert average_precision(truth, results_of(truth, "segmentation"), "segm") == pytest.approx(1, abs=1e-12)
    own = keypoint_results(truth, lambda extra: list(range(len(extra["visible_fraction"]))))
    assert average_precision(truth, own, "keypoints") == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("is_shown", [False, True])
def test_only_drogues_that_are_shown_have_keypoints(is_shown: bool, mixed_dataset: Path) -> None:
    manifest = Dataset(mixed_dataset).manifest
    angles = 2 * np.pi * np.arange(12) / 12
    ring = tuple((0.25 * np.cos(angle), 0.25 * np.sin(angle)) for angle in angles)
    twelve = PRESETS["red-8"].model_copy(update={"marker_positions_m": ring})
    # The mixed dataset's variants, of eight, five and seven markers, take the place of the recipe's own drogue.
    changes: dict[str, Any] = {"drogue": twelve}
    if is_shown:
        changes["target"] = manifest.recipe.target.model_copy(update={"variants": ()})
    shown = manifest.model_copy(update={"recipe": manifest.recipe.model_copy(update=changes)})
    category, *_ = coco_header(shown, with_features=False)["categories"]
    assert len(category["keypoints"]) == (12 if is_shown else 8)


def test_keypoints_in_the_image_order_are_perfect_up_to_a_turn(truth: Any) -> None:
    results = keypoint_results(truth, image_order)
    assert average_precision(truth, results, "keypoints") < 0.6
    assert average_precision(truth, align_keypoint_orders(truth, results), "keypoints") == pytest.approx(1, abs=1e-12)


EIGHT = even_ring(8, 0.27)
OWN_ORDERS = {
    "clockwise": EIGHT,
    "anticlockwise": EIGHT[::-1],
    "across": tuple(EIGHT[index] for index in (0, 4, 1, 5, 2, 6, 3, 7)),
    "free": ((0.27, 0.0), (-0.25, 0.05), (0.0, 0.27), (0.1, -0.24)),
    "two-rings": load_drogue("basket-strut-markers").marker_positions_m,
}


@pytest.mark.parametrize("positions_m", OWN_ORDERS.values(), ids=OWN_ORDERS)
def test_keypoints_in_the_image_order_are_perfect_whatever_the_drogue_s_own(positions_m: tuple, tmp_path: Path) -> None:
    drogue = load_drogue("basket-strut-markers" if len(positions_m) == 12 else "red-8")
    drogue = drogue.model_copy(update={"marker_positions_m": positions_m})
    annotations = []
    for index, roll in enumerate(np.radians([0.0, 17.0, 100.0])):
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        places_px = 300.0 * np.array(positions_m) @ turn.T + 200.0
        view = SimpleNamespace(markers=[SimpleNamespace(center_proj_px=place) for place in places_px])
        extra = {
            "keypoint_order_in_image": clockwise_order(cast(ViewRecord, view)),
            "equal_keypoint_orders": symmetric_orders(drogue),
        }
        points = np.column_stack([places_px, np.full(len(places_px), 2.0)]).ravel().tolist()
        number = {"id": index + 1, "image_id": index + 1, "category_id": DROGUE, "num_keypoints": len(places_px)}
        box = {"bbox": [50, 50, 300, 300], "area": 9e4, "iscrowd": 0}
        annotations.append({**number, **box, "keypoints": points, "droguekit": extra})
    sigmas = {"kpt_oks_sigmas": [0.02] * len(positions_m)}
    images = [{"id": index + 1, "width": 400, "height": 400} for index in range(3)]
    table = {"info": {"droguekit": sigmas}, "images": images, "categories": [{"id": DROGUE}]}
    file = tmp_path / "all.json"
    file.write_text(json.dumps({**table, "annotations": annotations}))
    for order_of in (image_order, lambda extra: extra["equal_keypoint_orders"][-1]):
        truth = COCO(str(file))
        results = align_keypoint_orders(truth, keypoint_results(truth, order_of))
        assert average_precision(truth, results, "keypoints") == pytest.approx(1, abs=1e-12)
    swapped = keypoint_results(truth, lambda extra: np.reshape(image_order(extra), (-1, 2))[:, ::-1].ravel())
    assert average_precision(truth, align_keypoint_orders(truth, swapped), "keypoints") < 0.2


def test_a_mirrored_order_is_no_turn(truth: Any) -> None:
    results = keypoint_results(truth, lambda extra: image_order(extra)[::-1])
    assert average_precision(truth, align_keypoint_orders(truth, results), "keypoints") < 0.2


def test_another_number_of_keypoints_is_refused(truth: Any) -> None:
    (result, *_) = keypoint_results(truth, image_order)
    with pytest.raises(ValueError, match="keypoints: must be 8 in every result, got 7"):
        align_keypoint_orders(truth, [{**result, "keypoints": result["keypoints"][:21]}])


def test_a_ring_turns_onto_itself_as_often_as_it_has_markers() -> None:
    assert symmetric_orders(PRESETS["red-5"]) == tuple(tuple((i + step) % 5 for i in range(5)) for step in range(5))
    places = list(PRESETS["red-8"].marker_positions_m)
    places[0] = (places[0][0] + 0.002, places[0][1])
    assert symmetric_orders(PRESETS["red-8"].model_copy(update={"marker_positions_m": tuple(places)})) == (
        tuple(range(8)),
    )


def test_ids_are_unique_and_stable(truth: Any, mixed_dataset: Path) -> None:
    ids = [annotation["id"] for annotation in truth.dataset["annotations"]]
    assert len(set(ids)) == len(ids) and min(ids) >= 1
    for annotation in truth.dataset["annotations"]:
        # What docs/reference/dataset-format.md promises.
        upper, image_id = divmod(annotation["id"], 2**25)
        assert image_id == annotation["image_id"]
        index = annotation["droguekit"].get("marker_index")
        assert upper == {DROGUE: 0, HUB: 1, MARKER: None if index is None else 2 + index}[annotation["category_id"]]


def test_drogues_are_those_of_the_dataset(truth: Any, mixed_dataset: Path) -> None:
    stored = json.loads((mixed_dataset / "annotations" / "all.json").read_text())
    assert stored["images"] == truth.dataset["images"]
    assert [c["name"] for c in stored["categories"]] == ["drogue"]
    assert [c["name"] for c in truth.dataset["categories"]] == ["drogue", "marker", "hub"]
    assert stored["annotations"] == [a for a in truth.dataset["annotations"] if a["category_id"] == DROGUE]


def test_masks_are_the_part_ids(truth: Any, mixed_dataset: Path) -> None:
    source, seen = Dataset(mixed_dataset), set()
    for index in source.frame_indices:
        drogue = source.record(index).frame.drogue
        for eye in EYES:
            part_id = source.part_ids(index, eye)
            wanted = [int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + 32)]
            features = [a for a in truth.imgToAnns[coco_image_id(index, eye)] if a["category_id"] != DROGUE]
            assert len(features) == sum((part_id == part).any() for part in wanted)
            for entry in features:
                marker = entry["droguekit"]["marker_index"]
                mask = part_id == (Part.HUB if marker is None else FIRST_MARKER_ID + marker)
                np.testing.assert_array_equal(truth.annToMask(entry).astype(bool), mask)
                rows, columns = np.nonzero(mask)
                assert entry["bbox"] == [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
                assert entry["area"] == mask.sum()
            if features:
                assert drogue is not None
                seen.add((drogue.name, any(a["category_id"] == HUB for a in features)))
    assert seen == {("red-8", True), ("white-5", True), ("bare-7", False)}


def test_all_drogues_have_eight_keypoints(truth: Any) -> None:
    assert len(truth.cats[DROGUE]["keypoints"]) == 8 == len(truth.dataset["info"]["droguekit"]["kpt_oks_sigmas"])
    for annotation in truth.anns.values():
        flags = annotation["keypoints"][2::3]
        assert len(flags) == 8 and annotation["num_keypoints"] == sum(flag > 0 for flag in flags)
        if annotation["category_id"] == DROGUE:
            assert not any(annotation["keypoints"][3 * len(annotation["droguekit"]["visible_fraction"]) :])


def test_splits_share_nothing_and_make_up_the_whole(mixed_dataset: Path, tmp_path: Path) -> None:
    whole, *parts = (json.loads(path.read_text()) for path in write_coco(mixed_dataset, tmp_path, ExportLog()))
    assert len(parts) == 3
    for key in ("images", "annotations"):
        ids = [entry["id"] for part in parts for entry in part[key]]
        assert len(set(ids)) == len(ids) and set(ids) == {entry["id"] for entry in whole[key]}
