"""Rendered pairs with a second drogue: labels against passes, validation, and exports as others read them."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, write_estimates
from drogue_models.parts import INSTANCE_STEP, Part, drogue_part_ids
from droguekit.scoring.detection.detection_metrics import AT_50, Evaluation
from droguekit.scoring.detection.detection_truth import read_detection_truth
from droguekit.scoring.results.detection_result import DetectedBox
from geometry.stereo import EYES
from labelgen.export.annotations.coco import DROGUE, write_coco
from labelgen.export.annotations.keypoint_orders import align_keypoint_orders
from labelgen.export.annotations.yolo import write_yolo_detect
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.packages.huggingface import write_huggingface
from labelgen.segmentation_masks import amodal_masks, named_parts, union_of_masks
from labelgen.validation.dataset_checks import validate_dataset
from studies.detector_comparison.peer_corpus import export_corpus
from tests.support.batch_datasets import FEWEST_RAYS, render_recipe
from tests.support.recipe_builder import RIG_320_PX, recipe_text, stations


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pairs with a second drogue, a receiver and distractors; to be read only."""
    text = recipe_text(
        name="several",
        seed=6,
        rig={**RIG_320_PX, "probe_tip_body_m": [2.6, 0.5, 0.35]},
        frames={"count": 4, "scenes": 4},
        distance=stations(3.0, 5.0),
        pose={"pitch_deg": [2, 10]},
        target={"distractor_frame_fraction": 1.0, "distractor_forms": ["nacelle", "roundel", "lamp", "bird"]},
        hose={},
        receiver={"nose_scene_fraction": 0.5},
        neighbours={"scene_fraction": 1.0, "distance_fraction": [1.2, 1.6]},
        render={**FEWEST_RAYS, "denoise": False},
    )
    folder: Path = tmp_path_factory.mktemp("several") / "dataset"
    render_recipe(folder, workers=0, text=text)
    return folder


def test_validation_finds_no_fault(dataset: Path) -> None:
    assert validate_dataset(dataset).faults == []


def test_every_drogue_is_seen_where_its_pose_says(dataset: Path) -> None:
    source, seen = Dataset(dataset), 0
    for index in source.frame_indices:
        record = source.record(index)
        for eye in EYES:
            part_id = source.part_ids(index, eye)
            view = record.views.left if eye == "left" else record.views.right
            for number, (other, labels) in enumerate(zip(record.frame.neighbours, view.neighbours, strict=True)):
                mask = np.isin(part_id, drogue_part_ids(other.drogue.marker_count, number + 1))
                assert labels.visible_drogue_px == mask.sum()
                if not mask.any():
                    continue
                rows, columns = np.nonzero(mask)
                middle = record.frame.rig.image(other.left_from_drogue.translation_m[None], eye)[0]
                assert columns.min() - 1 <= middle[0] <= columns.max() + 1
                assert rows.min() - 1 <= middle[1] <= rows.max() + 1
                # The rim's circle by the pose and the radius, against the pixels: wide by a pixel and a half at most.
                angle = np.linspace(0, 2 * np.pi, 60)
                rim = other.drogue.rim_radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
                outline = record.frame.rig.image(other.left_from_drogue.apply(rim), eye)
                hidden = labels.truncated or labels.box_visible_xywh_px[2] < 0.9 * labels.box_full_xywh_px[2]
                if not hidden:
                    assert columns.min() == pytest.approx(outline[:, 0].min(), abs=1.5)
                    assert columns.max() == pytest.approx(outline[:, 0].max(), abs=1.5)
                seen += 1
    assert seen >= 4


def test_hoses_of_both_have_ids_of_their_own(dataset: Path) -> None:
    source = Dataset(dataset)
    ids = {part for index in source.frame_indices for part in np.unique(source.part_ids(index, "left")).tolist()}
    assert int(Part.HOSE) in ids and INSTANCE_STEP + int(Part.HOSE) in ids
    assert max(ids) < 2 * INSTANCE_STEP


def test_amodal_masks_hold_the_visible_pixels_of_the_second_one(dataset: Path) -> None:
    source = Dataset(dataset)
    record = source.record(0)
    part_id = source.part_ids(0, "left")
    parts = named_parts(record)["neighbour_1"]
    amodal = union_of_masks(amodal_masks(record, "left", part_id), parts, part_id.shape)
    visible = np.isin(part_id, parts)
    assert visible.any() and not (visible & ~amodal).any()


def test_pycocotools_reads_several_drogues_an_image(dataset: Path, tmp_path: Path) -> None:
    write_coco(dataset, tmp_path, ExportLog())
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(tmp_path / "all.json"))
    source, pairs = Dataset(dataset), 0
    for image_id, image in coco.imgs.items():
        drogues = [entry for entry in coco.imgToAnns[image_id] if entry["category_id"] == DROGUE]
        about = image["droguekit"]
        record = source.record(about["frame_index"])
        part_id = source.part_ids(about["frame_index"], about["view"])
        shown = [k for k in (0, 1) if np.isin(part_id, drogue_part_ids(8, k)).any()]
        assert [entry["droguekit"]["sought"] for entry in drogues] == [k == 0 for k in shown]
        for instance, entry in zip(shown, drogues, strict=True):
            np.testing.assert_array_equal(
                coco.annToMask(entry).astype(bool), np.isin(part_id, drogue_part_ids(8, instance))
            )
            pose = record.left_from_drogue if instance == 0 else record.frame.neighbours[0].left_from_drogue
            assert pose is not None
            np.testing.assert_allclose(entry["droguekit"]["left_from_drogue"], pose.as_matrix())
        pairs += len(shown) == 2
    assert pairs >= 4
    assert len(coco.anns) == len(json.loads((tmp_path / "all.json").read_text())["annotations"])


def test_keypoints_are_aligned_with_those_of_the_sought_one(dataset: Path, tmp_path: Path) -> None:
    write_coco(dataset, tmp_path, ExportLog())
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(tmp_path / "all.json"))
    sought = [entry for entry in coco.anns.values() if entry["droguekit"].get("sought")]
    assert len(sought) < sum(entry["category_id"] == DROGUE for entry in coco.anns.values())
    turned = [
        {"image_id": entry["image_id"], "keypoints": entry["keypoints"][9:] + entry["keypoints"][:9]}
        for entry in sought
    ]
    aligned = align_keypoint_orders(coco, turned)
    assert [result["keypoints"] for result in aligned] == [entry["keypoints"] for entry in sought]


def test_yolo_has_a_row_for_each(dataset: Path, tmp_path: Path) -> None:
    write_yolo_detect(dataset, tmp_path / "yolo", ExportLog())
    source = Dataset(dataset)
    for index in source.frame_indices:
        for eye in EYES:
            (file,) = (tmp_path / "yolo" / "labels").glob(f"*/{index:06d}_{eye}.txt")
            rows = [line.split() for line in file.read_text().splitlines()]
            part_id = source.part_ids(index, eye)
            shown = sum(bool(np.isin(part_id, drogue_part_ids(8, k)).any()) for k in (0, 1))
            assert sum(row[0] == "0" for row in rows) == shown


def test_hugging_faces_card_names_their_parts_and_the_log_counts_them(dataset: Path, tmp_path: Path) -> None:
    log = ExportLog()
    write_huggingface(dataset, tmp_path / "hub", log)
    assert log.losses["drogues beside the sought one: left out of the objects"] == len(Dataset(dataset).frame_indices)
    card = (tmp_path / "hub" / "README.md").read_text(encoding="utf-8")
    assert f"{int(Part.HOSE)} hose" in card
    assert f"Those of a second drogue and its hose are {INSTANCE_STEP} higher, those of a third 128." in card


@pytest.mark.parametrize("format_", ["bop", "kitti", "parquet", "rosbag", "speed", "tum"])
def test_formats_of_one_drogue_count_the_others(dataset: Path, format_: str, tmp_path: Path) -> None:
    log = ExportLog()
    write_export(format_, dataset, tmp_path / "out", log)
    assert log.losses["drogues beside the sought one: left out"] == len(Dataset(dataset).frame_indices)


def test_trajectories_beside_estimates_count_the_others(dataset: Path, tmp_path: Path) -> None:
    pose = Dataset(dataset).record(0).left_from_drogue
    assert pose is not None
    write_estimates(tmp_path / "e.jsonl", [PoseEstimate(frame_index=0, method="joint", left_from_drogue=pose)])
    log = ExportLog()
    write_export("tum", dataset, tmp_path / "out", log, estimates=tmp_path / "e.jsonl")
    assert log.losses["drogues beside the sought one: left out"] == len(Dataset(dataset).frame_indices)


def test_networks_of_others_learn_all_of_them(dataset: Path, tmp_path: Path) -> None:
    write_yolo_detect(dataset, tmp_path / "yolo", ExportLog())
    export_corpus(dataset, tmp_path / "peers", (320, 256))
    several = 0
    for file in (tmp_path / "peers" / "labels").glob("*/*.txt"):
        (ours,) = (tmp_path / "yolo" / "labels").glob(f"*/{file.name}")
        rows, expected = (
            sorted([float(number) for number in line.split()] for line in path.read_text().splitlines())
            for path in (file, ours)
        )
        several += len(rows) > 1
        # 320 x 240 px in the middle of 320 x 256.
        moved = [
            [x, (240 * y + 8) / 256, width, 240 / 256 * height] for kind, x, y, width, height in expected if kind == 0
        ]
        np.testing.assert_allclose([row[1:] for row in rows], moved, atol=1e-5)  # written as text
    assert several >= 4


def test_detectors_have_to_find_all_of_them(dataset: Path) -> None:
    truth = read_detection_truth(dataset)
    others = [(image, box) for image in truth.images for box in image.others_xywh]
    sought = [(image, image.box_xywh) for image in truth.images if image.box_xywh is not None]
    assert len(others) >= 4
    perfect = [DetectedBox(image.image_id, box, 0.9) for image, box in [*sought, *others]]
    assert Evaluation(truth.images, perfect).average_precision(truth.images).ap == pytest.approx(1.0)
    half = Evaluation(truth.images, [DetectedBox(image.image_id, box, 0.9) for image, box in sought])
    matches = half.matches(truth.images)
    assert matches.drogues == len(sought) + len(others)
    assert matches.is_true[AT_50].sum() == len(sought)
    # The sought one counts as found only by a box on itself.
    wrong = Evaluation(truth.images, [DetectedBox(image.image_id, box, 0.9) for image, box in others])
    assert np.isneginf(wrong.matches(truth.images).found_scores()).all()
