from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.writer import leftovers
from drogue_models.parts import FIRST_MARKER_ID, drogue_part_ids
from geometry.stereo import EYES
from labelgen.export.annotations.coco import coco_annotation, coco_image_id, write_annotations
from labelgen.export.keypoints import clockwise_order
from tests.support.drawn_pairs import Pair


def test_image_ids_are_those_that_are_promised() -> None:
    assert [coco_image_id(0, "left"), coco_image_id(0, "right"), coco_image_id(7, "left")] == [1, 2, 15]


def test_files_load_and_agree_with_the_frames(small_dataset: Path, pairs: list[Pair]) -> None:
    coco = COCO(str(small_dataset / "annotations" / "all.json"))
    assert sorted(coco.imgs) == list(range(1, 2 * len(pairs) + 1))
    for pair in pairs:
        for eye in EYES:
            image = coco.imgs[coco_image_id(pair.frame.frame_index, eye)]
            assert (small_dataset / image["file_name"]).is_file()
            assert (image["width"], image["height"]) == pair.images.size_px
            annotations = coco.imgToAnns[image["id"]]
            if pair.frame.drogue is None:
                assert annotations == []
                continue
            (annotation,) = annotations
            part_id = getattr(pair.radiance, eye).part_id
            mask = np.isin(part_id, drogue_part_ids(8))
            np.testing.assert_array_equal(coco.annToMask(annotation), mask)
            assert annotation["area"] == mask.sum() and annotation["id"] >= 1
            rows, columns = np.nonzero(mask)
            # Corner coordinates: the first pixel reaches from 0 to 1.
            assert annotation["bbox"] == [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            points = np.array(annotation["keypoints"]).reshape(8, 3)
            assert (points[:, 2] == 2).all() and annotation["num_keypoints"] == 8
            for index, (x, y, _) in enumerate(points):
                # The pixel that holds a keypoint is the one that shows its marker.
                assert part_id[int(y), int(x)] == FIRST_MARKER_ID + index


def test_truth_against_itself_scores_one(small_dataset: Path) -> None:
    truth = COCO(str(small_dataset / "annotations" / "all.json"))
    results = [
        {key: annotation[key] for key in ("image_id", "category_id", "bbox")} | {"score": 0.9}
        for annotation in truth.anns.values()
    ]
    score = COCOeval(truth, truth.loadRes(results), "bbox")
    score.evaluate()
    score.accumulate()
    score.summarize()
    assert score.stats[0] == 1.0


def test_splits_hold_what_the_manifest_says(small_dataset: Path) -> None:
    manifest = read_manifest(small_dataset)
    whole = json.loads((small_dataset / "annotations" / "all.json").read_text())
    images, annotations = [], []
    for split in sorted(set(manifest.split_of_frame().values())):
        part = json.loads((small_dataset / "annotations" / f"{split}.json").read_text())
        assert {image["droguekit"]["split"] for image in part["images"]} == {split}
        images += part["images"]
        annotations += part["annotations"]
        assert part["categories"] == whole["categories"]
    by_id = {"key": lambda entry: entry["id"]}
    assert sorted(images, **by_id) == whole["images"] and sorted(annotations, **by_id) == whole["annotations"]


def test_the_same_dataset_gives_the_same_bytes(small_dataset: Path, tmp_path: Path) -> None:
    again = write_annotations(small_dataset, tmp_path / "again")
    for first, second in zip(sorted((small_dataset / "annotations").iterdir()), sorted(again), strict=True):
        assert first.name == second.name and first.read_bytes() == second.read_bytes()


def test_an_unreadable_frame_leaves_the_old_files(small_dataset: Path, full_pairs: list[Pair]) -> None:
    before = {path: path.read_bytes() for path in (small_dataset / "annotations").iterdir()}
    path = small_dataset / "frames" / f"{full_pairs[-1].frame.frame_index:06d}" / "right_parts.png"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"right_parts\.png: the PNG is truncated"):
        write_annotations(small_dataset, small_dataset / "annotations")
    assert {path: path.read_bytes() for path in (small_dataset / "annotations").iterdir()} == before
    assert leftovers(small_dataset) == []


def test_hidden_and_absent_keypoints(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    markers = list(pair.record.views.left.markers)
    markers[0] = markers[0].model_copy(update={"visible_fraction": 0.2})
    markers[1] = markers[1].model_copy(update={"center_proj_px": (-0.6, 10.0)})
    markers[2] = markers[2].model_copy(update={"center_proj_px": (-0.4, 10.0)})
    views = pair.record.views
    left = views.left.model_copy(update={"markers": tuple(markers)})
    record = pair.record.model_copy(update={"views": views.model_copy(update={"left": left})})
    annotation = coco_annotation(record, "left", pair.radiance.left.part_id, 8)
    points = np.array(annotation["keypoints"]).reshape(8, 3)
    assert points[0, 2] == 1 and points[1].tolist() == [0, 0, 0]
    np.testing.assert_allclose(points[2], [0.1, 10.5, 2], atol=1e-12)
    assert annotation["num_keypoints"] == 7


def test_order_in_the_image_starts_at_the_top_and_goes_clockwise(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        view = pair.record.views.left
        order = clockwise_order(view)
        assert sorted(order) == list(range(8))
        places = np.array([view.markers[index].center_proj_px for index in order])
        assert places[0, 1] == min(places[0, 1], places[1, 1], places[-1, 1])
        # Clockwise on a screen whose rows grow downwards: the shoelace area is positive.
        following = np.roll(places, -1, axis=0)
        assert (places[:, 0] * following[:, 1] - places[:, 1] * following[:, 0]).sum() > 0
