from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.image_codecs import encode_passes, read_passes
from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import Drop, build_manifest, read_manifest, write_manifest
from datasets_manifest.storage.writer import encode_files, write_frame
from drogue_models.parts import FIRST_MARKER_ID
from geometry.stereo import EYES
from labelgen.validation.dataset_checks import ValidationReport, validate_dataset
from render.engine import EyeRadiance
from tests.support.drawn_pairs import Pair

SPLITS = ("train", "val", "test")


@pytest.fixture
def with_passes(small_dataset: Path, full_pairs: list[Pair]) -> Callable[..., Any]:
    """Writes one pair again with EXR files that a test may change first; all hashes match."""

    def write(change: Callable[[Any], Any] = lambda passes: passes) -> Path:
        pair = full_pairs[0]
        seen = {eye: getattr(pair.radiance, eye) for eye in EYES}
        files = encode_files(pair.images, {eye: passes.part_id for eye, passes in seen.items()})
        seen["left"] = change(seen["left"])
        files |= {f"{eye}.exr": encode_passes(passes) for eye, passes in seen.items()}
        write_frame(small_dataset, pair.record, files)
        describe(small_dataset)
        return small_dataset

    return write


def describe(dataset: Path, drops: Sequence[Drop] = ()) -> None:
    manifest = read_manifest(dataset)
    splits = {entry.scene_id: entry.split for entry in manifest.frames}
    write_manifest(dataset, build_manifest(dataset, manifest.recipe, "1", splits, drops))


def changed(passes: EyeRadiance, **planes: np.ndarray) -> EyeRadiance:
    return type(passes)(**{**vars(passes), **planes})


def counts(report: ValidationReport) -> dict[str, int]:
    return {check.name: check.count for check in report.checks}


def test_passes_that_agree_pass(with_passes: Callable[..., Any]) -> None:
    report = validate_dataset(with_passes())
    assert report.faults == [] and counts(report)["depth and normals"] == 2


@pytest.mark.parametrize(
    ("plane", "change", "message"),
    [
        # 4 mm at 2 to 4 m: far beyond float32, far below what anybody would see.
        (
            "depth_m",
            lambda depth: np.where(np.isfinite(depth), depth + np.float32(0.004), depth),
            "off the plane of part",
        ),
        ("depth_m", lambda depth: np.where(depth < 1e9, np.inf, depth), "must be infinite for the sky and finite"),
        ("depth_m", lambda depth: np.where(depth < 1e9, np.nan, depth), "must be infinite for the sky and finite"),
        ("normal", lambda normal: normal * np.float32(1.01), "of length 1 elsewhere"),
        ("part_id", lambda part: np.roll(part, 1, axis=1), "pixels differ from the part ids"),
        ("radiance_cd_m2", lambda light: light * np.float32(np.nan), "must be finite"),
    ],
)
def test_passes_that_contradict_are_faults(
    with_passes: Callable[..., Any], full_pairs: list[Pair], plane: str, change: Callable[..., Any], message: str
) -> None:
    dataset = with_passes(
        lambda passes: changed(passes, **{plane: change(getattr(passes, plane)).astype(getattr(passes, plane).dtype)})
    )
    faults = validate_dataset(dataset).faults
    assert faults and all("left.exr" in fault for fault in faults)
    assert any(message in fault for fault in faults)


def test_a_damaged_pass_does_not_reach_the_decoder(with_passes: Callable[..., Any], full_pairs: list[Pair]) -> None:
    dataset = with_passes()
    path = frame_folder(dataset, full_pairs[0].frame.frame_index) / "left.exr"
    path.write_bytes(path.read_bytes()[:-50])
    (fault,) = validate_dataset(dataset).faults
    assert fault == f"{path}: was changed: its hash differs from the recorded one"


def test_a_pass_of_another_size_is_refused(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    data = encode_passes(pair.radiance.left)
    camera = pair.frame.rig.camera
    assert read_passes(data, "x", camera)["id.X"].max() >= FIRST_MARKER_ID
    # The attribute's name, type and size come before its four numbers.
    place = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    huge = data[: place + 8] + np.array([2**30, 2**30], dtype="<i4").tobytes() + data[place + 16 :]
    for wrong in (huge, data[:100], b"", b"\x89PNG", data[: len(data) // 2]):
        with pytest.raises(ValueError, match=r"^x: "):
            read_passes(wrong, "x", camera)


def test_calibration_files_are_compared_with_the_rig(small_dataset: Path) -> None:
    folder = small_dataset / "calibration"
    path = folder / "ros_right.yaml"
    path.write_text(path.read_text().replace("cols: 4", "cols: 3"))
    storage = cv2.FileStorage(str(folder / "opencv_stereo.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("M1", np.eye(3))
    storage.release()
    faults = validate_dataset(small_dataset).faults
    assert faults == [
        f"{folder / name}: is not that of the manifest's rig" for name in ("opencv_stereo.yaml", path.name)
    ]
    (folder / "opencv_stereo.yaml").unlink()
    assert f"{folder / 'opencv_stereo.yaml'}: is missing" in validate_dataset(small_dataset).faults


def test_drops_are_compared_with_the_frames(small_dataset: Path) -> None:
    describe(small_dataset, [Drop(frame_index=2, reason="tried"), Drop(frame_index=77, reason="tried")])
    faults = validate_dataset(small_dataset).faults
    assert faults == [
        "manifest.json: frame 2 is both made and dropped",
        "manifest.json: frame 77 is not among the recipe's 6",
    ]


def test_a_center_outside_its_box_is_a_fault(small_dataset: Path, full_pairs: list[Pair]) -> None:
    path = frame_folder(small_dataset, full_pairs[0].frame.frame_index) / "record.json"
    table = json.loads(path.read_text())
    table["views"]["left"]["box_full_xywh_px"][0] += table["views"]["left"]["box_full_xywh_px"][2] / 2
    path.write_text(json.dumps(table))
    describe(small_dataset)
    faults = validate_dataset(small_dataset).faults
    assert sum("lies outside box_full_xywh_px" in fault for fault in faults) >= 3


def test_a_record_of_another_rig_is_a_fault(small_dataset: Path, full_pairs: list[Pair]) -> None:
    path = frame_folder(small_dataset, full_pairs[0].frame.frame_index) / "record.json"
    table = json.loads(path.read_text())
    table["frame"]["rig"]["baseline_m"] = 0.13
    path.write_text(json.dumps(table))
    describe(small_dataset)
    assert f"{path}: frame.rig: differs from that of the dataset's recipe" in validate_dataset(small_dataset).faults
