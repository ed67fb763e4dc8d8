"""Bags as another library reads them: written by rosbags, read by mcap."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import leftovers
from drogue_models.presets import load_drogue
from droguekit.cli.main import DONE, run
from geometry.se3 import RigidTransform
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.poses.rosbag import POSE_TOPIC, camera_info_topic, image_topic
from tests.support.drawn_pairs import Pair, write_drawn_dataset
from tests.support.recipe_builder import Section

Messages = dict[str, list[tuple[int, Any]]]


def read_bag(folder: Path) -> Messages:
    """All messages of a bag with their times [ns], by topic."""
    (file,) = folder.glob("*.mcap")
    found: Messages = defaultdict(list)
    with file.open("rb") as stream:
        for _, channel, raw, decoded in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found[channel.topic].append((raw.log_time, decoded))
    return found


def transform_of(stamped: Any) -> RigidTransform:
    """`parent_from_child` of a TransformStamped."""
    t, q = stamped.transform.translation, stamped.transform.rotation
    return RigidTransform(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([t.x, t.y, t.z]))


@pytest.fixture
def bag(small_dataset: Path, tmp_path: Path) -> Messages:
    (folder,) = write_export("rosbag", small_dataset, tmp_path / "bags", ExportLog())
    return read_bag(folder)


def test_images_and_times_are_the_datasets(bag: Messages, small_dataset: Path) -> None:
    source = Dataset(small_dataset)
    for eye in ("left", "right"):
        messages = bag[image_topic(eye)]
        assert len(messages) == len(source.frame_indices)
        for frame_index, (log_time, image) in zip(source.frame_indices, messages, strict=True):
            pixels = getattr(source.images(frame_index), eye)
            assert (image.encoding, image.step) == ("rgb8", 3 * image.width)
            np.testing.assert_array_equal(np.frombuffer(image.data, np.uint8).reshape(pixels.shape), pixels)
            stamp_ns = image.header.stamp.sec * 10**9 + image.header.stamp.nanosec
            assert stamp_ns == log_time == round(source.record(frame_index).time_s * 1e9)


@pytest.mark.parametrize(
    ("preset", "rig", "encoding", "bits", "black_level_dn"),
    [
        # The sensors' black level is 64 of 4096.
        ("rgb-ideal", {}, "linear", 8, 4),
        ("mono", {"output_bits": 12}, "linear", 12, 64),
        # On the sRGB curve, which begins at the black level, nothing but light gives a number.
        ("mono", {"encoding": "gamma"}, "gamma", 8, 0),
        # The bag has the mosaic, which is linear.
        ("paper-colour", {"encoding": "gamma"}, "linear", 8, 4),
    ],
)
def test_what_the_numbers_mean_stands_beside_every_pair(
    preset: str,
    rig: Section,
    encoding: str,
    bits: int,
    black_level_dn: int,
    dataset_by_preset: Callable[..., Path],
    tmp_path: Path,
) -> None:
    source = Dataset(dataset_by_preset(preset, rig))
    (folder,) = write_export("rosbag", source.path, tmp_path / "bags", ExportLog())
    found = [json.loads(message.data) for _, message in read_bag(folder)["/stereo/pixel_values"]]
    for index, values in zip(source.frame_indices, found, strict=True):
        record = source.record(index)
        assert values == {
            "stamp_ns": round(record.time_s * 1e9),
            "encoding": encoding,
            "bits": bits,
            "black_level_dn": black_level_dn,
            "exposure_s": record.frame.exposure.time_s,
        }


def test_calibration_gives_the_baseline_and_both_eyes_the_left_frame(bag: Messages) -> None:
    left, right = (bag[camera_info_topic(eye)][0][1] for eye in ("left", "right"))
    assert left.header.frame_id == right.header.frame_id == "stereo_left_optical"
    assert left.p[3] == 0.0
    # REP-104: the right eye's P[0, 3] is -f B; the paper's baseline is 0.12 m.
    assert -right.p[3] / right.p[0] == pytest.approx(0.12, abs=1e-12)
    np.testing.assert_array_equal(left.k, [266.0, 0, 79.5, 0, 266.0, 59.5, 0, 0, 1])


def test_truth_stands_in_pose_and_transforms(bag: Messages, small_dataset: Path) -> None:
    source = Dataset(small_dataset)
    records = [source.record(index) for index in source.frame_indices]
    seen = [record for record in records if record.left_from_drogue is not None]
    assert 0 < len(seen) < len(records)
    assert len(bag[POSE_TOPIC]) == len(seen)
    fixed = {t.child_frame_id: transform_of(t) for _, tf in bag["/tf_static"] for t in tf.transforms}
    np.testing.assert_allclose(fixed["stereo_right_optical"].translation_m, [0.12, 0, 0])
    # What lies before the camera lies before a body of REP-103 too, what lies to its right at negative y.
    np.testing.assert_allclose(fixed["stereo_left_optical"].apply([0.3, 0.2, 5.0]), [5.0, -0.3, -0.2], atol=1e-15)
    for record, (_, tf) in zip(records, bag["/tf"], strict=True):
        moving = {t.child_frame_id: transform_of(t) for t in tf.transforms}
        world_from_left = moving["base_link"] @ fixed["stereo_left_optical"]
        # Quaternions there and back cost a few roundings.
        np.testing.assert_allclose(world_from_left.as_matrix(), record.frame.world_from_left.as_matrix(), atol=1e-12)
        if record.left_from_drogue is not None:
            truth = record.left_from_drogue.as_matrix()
            np.testing.assert_allclose(moving["drogue"].as_matrix(), truth, atol=1e-12)


def test_metadata_counts_what_the_file_holds(bag: Messages, tmp_path: Path) -> None:
    told = yaml.safe_load((tmp_path / "bags" / "single_pairs" / "metadata.yaml").read_text())
    information = told["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    counts = {t["topic_metadata"]["name"]: t["message_count"] for t in information["topics_with_message_count"]}
    assert counts == {topic: len(messages) for topic, messages in bag.items()}


def test_metadata_have_the_form_of_humble(bag: Messages, tmp_path: Path) -> None:
    told = yaml.safe_load((tmp_path / "bags" / "single_pairs" / "metadata.yaml").read_text())
    topics = [entry["topic_metadata"] for entry in told["rosbag2_bagfile_information"]["topics_with_message_count"]]
    assert {topic["name"] for topic in topics} == set(bag)
    for topic in topics:
        # Humble reads a text, and in it the numbers of ROS's middleware.
        text = topic["offered_qos_profiles"]
        assert isinstance(text, str)
        (profile,) = yaml.safe_load(text)
        assert (profile["history"], profile["reliability"]) == (1, 1)
        assert profile["durability"] == (1 if topic["name"] == "/tf_static" else 2)
    assert run(["import", str(tmp_path / "bags" / "single_pairs"), "--out", str(tmp_path / "imported")]) == DONE


def test_the_same_dataset_gives_the_same_bytes(small_dataset: Path, tmp_path: Path) -> None:
    log = ExportLog()
    for name in ("one", "two"):
        write_export("rosbag", small_dataset, tmp_path / name, log)
    for file in sorted((tmp_path / "one").rglob("*.*")):
        assert file.read_bytes() == (tmp_path / "two" / file.relative_to(tmp_path / "one")).read_bytes()
    empty = sum(entry.empty for entry in Dataset(small_dataset).manifest.frames)
    assert log.losses == {"pairs without a drogue have no pose": 2 * empty}


def test_a_damaged_pair_leaves_no_bag_behind(small_dataset: Path, tmp_path: Path) -> None:
    record = small_dataset / "frames" / "000003" / "record.json"
    table = json.loads(record.read_text())
    table["time_s"] = 0.0
    record.write_text(json.dumps(table))
    with pytest.raises(ValueError, match="frame 3: time_s: must be later"):
        write_export("rosbag", small_dataset, tmp_path / "bags", ExportLog())
    assert not (tmp_path / "bags").exists() and leftovers(tmp_path) == []


def test_the_drogue_that_import_must_be_told_is_named(
    small_dataset: Path, mixed_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(small_dataset), "--format", "rosbag", "--out", str(tmp_path / "one")]) == DONE
    name = Dataset(small_dataset).manifest.recipe.drogue.name
    assert f"rosbag: import it with --drogue {name}\n" in capsys.readouterr().out
    log = ExportLog()
    write_export("rosbag", mixed_dataset, tmp_path / "several", log)
    assert log.remarks == ["shows several drogues, and import knows one for all pairs"]


def test_a_drogue_that_ships_with_nobody_is_written_beside_the_bags(
    small_recipe: Recipe, full_pairs: list[Pair], tmp_path: Path
) -> None:
    own = small_recipe.drogue.model_copy(update={"name": "own", "rib_count": 7})
    dataset = write_drawn_dataset(tmp_path / "own", small_recipe.model_copy(update={"drogue": own}), full_pairs[:1])
    log, file = ExportLog(), tmp_path / "bags" / "drogue.toml"
    bag, written = write_export("rosbag", dataset, tmp_path / "bags", log)
    assert written == file and log.remarks == [f"import it with --drogue {file}"]
    assert load_drogue(str(file)) == own
    assert run(["import", str(bag), "--drogue", str(file), "--out", str(tmp_path / "imported")]) == DONE


def test_a_bag_of_a_bayer_sensor_is_imported_with_its_mosaics(
    dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    source = Dataset(dataset_by_preset("paper-colour"))
    (bag,) = write_export("rosbag", source.path, tmp_path / "bags", ExportLog())
    assert run(["import", str(bag), "--out", str(tmp_path / "imported")]) == DONE
    imported = BlindDataset(tmp_path / "imported")
    for place, index in enumerate(source.frame_indices):
        got, want = imported.pair(place).images, source.images(index)
        assert want.left_mosaic is not None and want.right_mosaic is not None
        np.testing.assert_array_equal(got.left_mosaic, want.left_mosaic)
        np.testing.assert_array_equal(got.right_mosaic, want.right_mosaic)
        assert (got.encoding, got.black_level_dn, got.exposure_s) == ("linear", want.black_level_dn, want.exposure_s)
