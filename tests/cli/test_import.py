"""Images that came from a dataset, imported as if a real camera had taken them: navigation must find the same poses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import leftovers
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from droguekit.cli.main import DONE, WRONG_INPUT, run
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export


def poses(dataset: Path, out: Path) -> dict[int, np.ndarray]:
    """What `navigate` finds, by pair."""
    assert run(["navigate", str(dataset), "--method", "joint", "--out", str(out)]) == DONE
    found = read_estimates(out)
    return {e.frame_index: e.left_from_drogue.as_matrix() for e in found if isinstance(e, PoseEstimate)}


@pytest.fixture
def pictures(smoke_dataset: Path, tmp_path: Path) -> Path:
    """A folder as a camera's software leaves it: left_0001.png, right_0001.png ..."""
    folder = tmp_path / "flight"
    folder.mkdir()
    for index in Dataset(smoke_dataset).frame_indices:
        for eye in ("left", "right"):
            shutil.copy(smoke_dataset / "frames" / f"{index:06d}" / f"{eye}.png", folder / f"{eye}_{index:04d}.png")
    return folder


def arguments(source: Path, dataset: Path, out: Path) -> list[str]:
    black_level = Dataset(dataset).record(0).image_black_level_dn
    calibration = dataset / "calibration" / "opencv_stereo.yaml"
    return [
        *("import", str(source), "--out", str(out), "--calibration", str(calibration)),
        *("--encoding", "linear", "--black-level", str(black_level)),
    ]


def drogue_boxes(dataset: Path) -> dict[str, Any]:
    """A COCO file of the drogue's boxes, as somebody would draw them on `pictures`."""
    table: dict[str, Any] = json.loads((dataset / "annotations" / "all.json").read_text())
    drogue = next(c["id"] for c in table["categories"] if c["name"] == "drogue")
    table["annotations"] = [a for a in table["annotations"] if a["category_id"] == drogue]
    for image in table["images"]:
        frame, eye = Path(image["file_name"]).parent.name, Path(image["file_name"]).stem
        image["file_name"] = f"{eye}_{int(frame):04d}.png"
    return table


def test_imported_images_give_the_same_poses(smoke_dataset: Path, pictures: Path, tmp_path: Path) -> None:
    assert run(arguments(pictures, smoke_dataset, tmp_path / "imported")) == DONE
    imported, source = BlindDataset(tmp_path / "imported"), Dataset(smoke_dataset)
    assert len(imported.frame_indices) == len(source.frame_indices)
    for place, index in enumerate(source.frame_indices):
        np.testing.assert_array_equal(imported.pair(place).images.right, source.images(index).right)
    want, got = poses(smoke_dataset, tmp_path / "a.jsonl"), poses(tmp_path / "imported", tmp_path / "b.jsonl")
    assert len(want) > 0 and sorted(got) == [source.frame_indices.index(index) for index in sorted(want)]
    for index, pose in want.items():
        # The same pixels and the same rig: only sums in another order.
        np.testing.assert_allclose(got[source.frame_indices.index(index)], pose, atol=1e-9)


def test_deep_images_keep_their_black_level(smoke_dataset: Path, pictures: Path, tmp_path: Path) -> None:
    for file in pictures.iterdir():
        image = cv2.imread(str(file)).astype(np.uint16) << 8
        assert cv2.imwrite(str(file), image)
    order = ["import", str(pictures), "--calibration", str(smoke_dataset / "calibration" / "opencv_stereo.yaml")]
    assert run([*order, "--out", str(tmp_path / "imported"), "--black-level", "1024"]) == DONE
    pair = BlindDataset(tmp_path / "imported").pair(0).images
    # 16 bits are kept as 12: numbers and black level are a sixteenth.
    assert (pair.bits, pair.black_level_dn, pair.encoding) == (12, 64.0, "linear")
    want = cv2.imread(str(pictures / "left_0000.png"), cv2.IMREAD_UNCHANGED)[:, :, ::-1] >> 4
    np.testing.assert_array_equal(pair.left, want)
    assert run([*order, "--out", str(tmp_path / "other"), "--black-level", "65535"]) == WRONG_INPUT


def test_views_side_by_side_are_the_same_pairs(smoke_dataset: Path, pictures: Path, tmp_path: Path) -> None:
    wide = tmp_path / "wide"
    wide.mkdir()
    for left in sorted(pictures.glob("left_*")):
        right = left.with_name(left.name.replace("left", "right"))
        both = np.concatenate([cv2.imread(str(left)), cv2.imread(str(right))], axis=1)
        assert cv2.imwrite(str(wide / left.name.replace("left_", "")), both)
    for source, out in ((pictures, "two"), (wide, "one")):
        assert run(arguments(source, smoke_dataset, tmp_path / out)) == DONE
    for file in sorted((tmp_path / "two" / "frames").rglob("*.*")):
        assert file.read_bytes() == (tmp_path / "one" / file.relative_to(tmp_path / "two")).read_bytes()


def test_a_bag_brings_its_calibration(smoke_dataset: Path, tmp_path: Path) -> None:
    (bag,) = write_export("rosbag", smoke_dataset, tmp_path / "bags", ExportLog())
    assert run(["import", str(bag), "--out", str(tmp_path / "imported")]) == DONE
    imported, source = BlindDataset(tmp_path / "imported"), Dataset(smoke_dataset)
    for place, index in enumerate(source.frame_indices):
        got, want = imported.pair(place), source.images(index)
        np.testing.assert_array_equal(got.images.left, want.left)
        for name in ("encoding", "black_level_dn", "bits", "exposure_s"):
            assert getattr(got.images, name) == getattr(want, name), name
        assert got.images.time_s == pytest.approx(want.time_s, abs=1e-9)
        rig = source.manifest.recipe.rig
        assert got.rig.camera == rig.camera and got.rig.lenses is None
        assert got.rig.baseline_m == pytest.approx(rig.baseline_m, rel=1e-12)


@pytest.mark.parametrize(
    ("option", "fault"),
    [
        (("--encoding", "gamma"), "--encoding: the source says linear, got gamma; leave the option out"),
        (("--black-level", "99"), "--black-level: the source says "),
        (("--rate", "10"), "--rate, --boxes, --folders: are for folders of images"),
        (("--folders", "left,right"), "--rate, --boxes, --folders: are for folders of images"),
        (("--camera-info", "/a"), "--camera-info: must be LEFT,RIGHT, got '/a'"),
        (("--camera-info", "/a,/b"), "has no CameraInfo on /a and /b; choose it by --camera-info"),
        (("--topics", "/a,/a"), "--topics: must be LEFT,RIGHT, got '/a,/a'"),
        (("--stamp-tolerance-ms", "-1"), "--stamp-tolerance-ms: must be from 0 to 1000, got -1"),
    ],
)
def test_options_that_do_not_go_with_a_bag_are_one_line(
    option: tuple[str, str], fault: str, smoke_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (bag,) = write_export("rosbag", smoke_dataset, tmp_path / "bags", ExportLog())
    assert run(["import", str(bag), "--out", str(tmp_path / "imported"), *option]) == WRONG_INPUT
    said = capsys.readouterr().err
    assert fault in said and said.count("\n") == 1
    assert not (tmp_path / "imported").exists()


def test_a_bag_in_a_folder_is_found(smoke_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The folder that `export` made, its bag, and the bag's file alone."""
    (bag,) = write_export("rosbag", smoke_dataset, tmp_path / "bags", ExportLog())
    (file,) = bag.glob("*.mcap")
    for place, source in enumerate((tmp_path / "bags", bag, file)):
        assert run(["import", str(source), "--out", str(tmp_path / f"imported-{place}")]) == DONE
    first, *others = (sorted((tmp_path / f"imported-{place}" / "frames").rglob("*.*")) for place in range(3))
    for files in others:
        assert [path.read_bytes() for path in files] == [path.read_bytes() for path in first]
    shutil.copytree(bag, tmp_path / "bags" / "second")
    assert run(["import", str(tmp_path / "bags"), "--out", str(tmp_path / "several")]) == WRONG_INPUT
    assert "holds several bags, such as" in capsys.readouterr().err


def test_what_pixel_values_were_taken_for_is_said(
    smoke_dataset: Path, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*arguments(pictures, smoke_dataset, tmp_path / "said"), "--rate", "25"]) == DONE
    said = capsys.readouterr()
    assert "pixel values: 8 bits, linear, black level" in said.err + said.out
    assert "times: 25 pairs a second (--rate)" in said.err + said.out
    assert "assumed" not in said.err + said.out
    calibration = str(smoke_dataset / "calibration" / "opencv_stereo.yaml")
    assert run(["import", str(pictures), "--out", str(tmp_path / "unsaid"), "--calibration", calibration]) == DONE
    said = capsys.readouterr()
    line = "pixel values: 8 bits, gamma, black level 0 DN; assumed, without --encoding, --black-level"
    assert line in said.err + said.out and "times: 25 pairs a second; assumed, without --rate" in said.err + said.out
    (bag,) = write_export("rosbag", smoke_dataset, tmp_path / "bags", ExportLog())
    assert run(["import", str(bag), "--out", str(tmp_path / "bag")]) == DONE
    said = capsys.readouterr()
    assert "DN, as the source says" in said.err + said.out


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("nowhere", "nowhere: there is no such file or folder"),
        ("film.mp4", "film.mp4: must be a folder of images, or a ROS bag"),
        ("empty", "empty: holds no images"),
        ("bad.mcap", "bad.mcap: cannot be read as a ROS bag"),
        ("bad.db3", "bad.db3: cannot be read as a ROS bag"),
    ],
)
def test_source_is_checked_before_the_calibration(
    name: str, fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    for file in ("film.mp4", "bad.mcap", "bad.db3"):
        (tmp_path / file).write_bytes(b"no bag")
    for calibration in ((), ("--calibration", str(tmp_path / "none.yaml"))):
        order = ["import", str(tmp_path / name), "--out", str(tmp_path / "imported"), *calibration]
        assert run(order) == WRONG_INPUT
        said = capsys.readouterr().err
        assert fault in said and "calibration" not in said and said.count("\n") == 1


def test_boxes_come_along(smoke_dataset: Path, pictures: Path, tmp_path: Path) -> None:
    table = drogue_boxes(smoke_dataset)
    (tmp_path / "boxes.json").write_text(json.dumps(table))
    order = [*arguments(pictures, smoke_dataset, tmp_path / "imported"), "--boxes", str(tmp_path / "boxes.json")]
    assert run(order) == DONE
    got = COCO(str(tmp_path / "imported" / "annotations" / "all.json"))
    assert len(got.anns) == len(table["annotations"]) > 0
    for annotation in table["annotations"]:
        assert got.imgToAnns[annotation["image_id"]][0]["bbox"] == annotation["bbox"]


def test_boxes_that_fit_no_image_leave_no_dataset(
    smoke_dataset: Path, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = drogue_boxes(smoke_dataset)
    for image in table["images"]:
        image["file_name"] = f"other_{image['file_name']}"
    (tmp_path / "boxes.json").write_text(json.dumps(table))
    order = [*arguments(pictures, smoke_dataset, tmp_path / "imported"), "--boxes", str(tmp_path / "boxes.json")]
    assert run(order) == WRONG_INPUT
    assert "belongs to these images" in capsys.readouterr().err
    assert not (tmp_path / "imported").exists()


def test_the_benchmark_checks_poses_without_truth(smoke_dataset: Path, pictures: Path, tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.json"
    boxes.write_text(json.dumps(drogue_boxes(smoke_dataset)))
    imported, html = tmp_path / "imported", tmp_path / "report.html"
    assert run([*arguments(pictures, smoke_dataset, imported), "--boxes", str(boxes)]) == DONE
    found = len(poses(imported, tmp_path / "a.jsonl"))
    files = ("--estimates", str(tmp_path / "a.jsonl"), "--json", str(tmp_path / "b.json"), "--html", str(html))
    assert run(["benchmark", str(imported), *files]) == DONE
    row = json.loads((tmp_path / "b.json").read_text())["methods"]["joint"]
    assert row["n"] == len(BlindDataset(imported).frame_indices) and row["fixes"] == found
    # Centroids of these images err by less than a tenth of a pixel, and the rim is nearly the whole drogue.
    assert row["residual_rms_px"] < 0.1
    assert row["boxes"] == 2 * found and row["middle_in_box_fraction"] == 1.0 and row["rim_box_iou_median"] > 0.9
    assert html.read_text().count("<figure>") == min(12, row["n"])


def test_the_preview_shows_imported_pairs(smoke_dataset: Path, pictures: Path, tmp_path: Path) -> None:
    assert run(arguments(pictures, smoke_dataset, tmp_path / "imported")) == DONE
    order = ["preview", str(tmp_path / "imported"), "--out", str(tmp_path / "sheet.png"), "--columns", "3"]
    assert run(order) == DONE
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    # Three tiles of 400 px side by side, with gaps of 4 px; the sky is brighter than the paper between them.
    assert sheet.shape[1] == 3 * 404 + 4 and np.median(sheet) > 24
    assert run([*order, "--by-family"]) == WRONG_INPUT


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (("--calibration", "none.yaml"), "no such calibration"),
        (("--drogue", "blue-9"), "no preset"),
        (("--encoding", "log"), "--encoding"),
        (("--rate", "0"), "--rate"),
        (("--calibration-unit", "ft"), "--calibration-unit"),
        (("--topics", "a,b"), "is not a ROS bag"),
        (("--camera-info", "a,b"), "is not a ROS bag"),
        (("--folders", "a"), "--folders: must be LEFT,RIGHT, got 'a'"),
        (("--folders", "a,b"), "a is not a folder"),
        (("--stamp-tolerance-ms", "1"), "--stamp-tolerance-ms needs a time stamp in the name of every image"),
        (("--boxes", "none.json"), "none.json"),
        (("--box-category", "basket"), "--box-category"),
    ],
)
def test_wrong_options_are_one_line(
    change: tuple[str, str],
    fault: str,
    smoke_dataset: Path,
    pictures: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run([*arguments(pictures, smoke_dataset, tmp_path / "imported"), *change]) == WRONG_INPUT
    said = capsys.readouterr().err
    assert fault in said and said.count("\n") == 1
    assert not (tmp_path / "imported").exists()


def test_an_image_of_another_size_leaves_nothing(
    smoke_dataset: Path, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cv2.imwrite(str(sorted(pictures.glob("right_*"))[-1]), np.zeros((10, 12, 3), np.uint8))
    assert run(arguments(pictures, smoke_dataset, tmp_path / "imported")) == WRONG_INPUT
    assert "as calibrated, got 12x10" in capsys.readouterr().err
    assert not (tmp_path / "imported").exists() and leftovers(tmp_path) == []
