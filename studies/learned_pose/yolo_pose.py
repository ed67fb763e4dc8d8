"""YOLO26n-pose of ultralytics: its training on crops of our renders, and its keypoints in crops.

The environment, training and export are those of the detector comparison. One class, the drogue, and as many keypoints
as the ring has markers, clockwise from the top.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import new_folder, write_text_atomic
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.manifest import SplitName
from geometry.se3 import Array
from nav.detector.input_image import network_input
from studies.detector_comparison.peer_corpus import training_image_count, training_length
from studies.detector_comparison.peer_detector import open_session
from studies.detector_comparison.peer_environment import peer_python, run_script, script_variables
from studies.detector_comparison.peers import ULTRALYTICS_SCRIPT, ULTRALYTICS_STEP_IMAGES
from studies.learned_pose.keypoint_corpus import EyeSample, split_samples
from studies.learned_pose.keypoint_crops import (
    CROP_PX,
    CropView,
    build_crop,
    crop_from_patch,
    image_from_crop,
    inverse_affine,
    map_points,
)
from studies.learned_pose.ring_keypoints import clockwise_from_top

NAME = "yolo26n-pose"
_SPLITS: tuple[SplitName, ...] = ("train", "val")
# Every keypoint is labelled and visible, in the format of COCO.
_VISIBLE = 2
# Channels of the network: box, score, then x, y and score of every keypoint.
_SCORE_CHANNEL, _FIRST_KEYPOINT, _KEYPOINT_CHANNELS = 4, 5, 3
# A best cell with a lower score is no drogue; the crops all show one.
_LEAST_SCORE = 0.05


@dataclass(frozen=True)
class YoloTraining:
    """Options of the training.

    Attributes:
        image_passes: rounded to whole epochs.
        batch: images that go through the network at once.
        threads: that it may use.
        seed: of the training.
        environment: folder of ultralytics' virtual environment.
    """

    image_passes: int
    batch: int
    threads: int
    seed: int
    environment: Path


def mirrored_keypoints(count: int) -> list[int]:
    """For each keypoint clockwise from the top, the one that it becomes in a mirrored image."""
    return list(range(count))[::-1]


def label_row(sample: EyeSample) -> str:
    """Class, box and keypoints of a crop as fractions of its size, as ultralytics reads them."""
    # Corner coordinates: the low corner of the first pixel is 0.
    keypoints = (map_points(crop_from_patch(CropView()), sample.markers_px) + 0.5) / CROP_PX
    keypoints = keypoints[clockwise_from_top(keypoints)]
    x, y, width, height = sample.true_box_xywh_px
    crop_from_image = inverse_affine(image_from_crop(sample.patch, CropView()))
    low, high = map_points(crop_from_image, np.array([[x, y], [x + width, y + height]])) + 0.5
    box = np.concatenate([(low + high) / 2, high - low]) / CROP_PX
    values = [*box.tolist(), *(value for point in keypoints.tolist() for value in (*point, _VISIBLE))]
    return f"0 {' '.join(map(repr, values))}\n"


def export_crops(corpus: Path, out: Path) -> Path:
    """Write crops and labels, unless they exist already.

    Returns:
        The file `data.yaml`.

    Raises:
        ValueError: the corpus cannot be read, or a split is empty.
        OSError: the folder cannot be written; no partial folder is left.
    """
    data = out / "data.yaml"
    if data.exists():
        return data
    with new_folder(out) as folder:
        count = 0
        for split in _SPLITS:
            for kind in ("images", "labels"):
                (folder / kind / split).mkdir(parents=True)
            samples = 0
            for sample in split_samples(corpus, split):
                name, samples, count = (
                    f"{split}/{sample.frame_index:06d}_{sample.eye}",
                    samples + 1,
                    len(sample.markers_px),
                )
                crop = build_crop(sample.patch.pixels, CropView())
                (folder / "images" / f"{name}.png").write_bytes(encode_png(crop))
                (folder / "labels" / f"{name}.txt").write_text(label_row(sample), encoding="utf-8")
            if not samples:
                raise ValueError(f"{corpus}: has no pairs in the split {split}")
        lines = "".join(f"{split}: images/{split}\n" for split in _SPLITS)
        lines += f"kpt_shape: [{count}, 3]\nflip_idx: {mirrored_keypoints(count)}\nnames:\n  0: drogue\n"
        (folder / "data.yaml").write_text(f'path: ""\n{lines}', encoding="utf-8")
    return data


def train_yolo(corpus: Path, out: Path, training: YoloTraining, say: Callable[[str], None]) -> Path:
    """The trained network as an ONNX file for two crops; a stage whose output exists is skipped.

    Raises:
        ValueError: the corpus cannot be read.
        OSError: the environment cannot be made, or the training or the export failed; the message names the log.
    """
    file = (out / f"{NAME}.onnx").resolve()
    if file.exists():
        return file
    python = peer_python(training.environment, say)
    folder = (out / NAME).resolve()
    variables = script_variables(out / "ultralytics", training.threads)
    done = folder / "trained"
    if not done.exists():
        data = export_crops(corpus, out / "crops").resolve()
        length = training_length(training.image_passes, training_image_count(corpus))
        say(f"{NAME}: {length.epochs} epochs, {length.image_passes} image passes; {folder / 'train.log'}")
        task = {
            "do": "train",
            "config": f"{NAME}.yaml",
            "data": str(data),
            "folder": str(folder),
            "epochs": length.epochs,
            "fraction": length.fraction,
            "size_px": (CROP_PX, CROP_PX),
            "batch": training.batch,
            "step_images": ULTRALYTICS_STEP_IMAGES,
            "threads": training.threads,
            "device": "cpu",
            "seed": training.seed,
        }
        run_script(python, ULTRALYTICS_SCRIPT, task, folder / "train.log", variables)
        write_text_atomic(done, "")
    part = file.with_suffix(".part.onnx")
    weights = str(folder / "train" / "weights" / "best.pt")
    size_px = (CROP_PX, CROP_PX)
    export = {"do": "export", "config": f"{NAME}.yaml", "weights": weights, "file": str(part), "size_px": size_px}
    run_script(python, ULTRALYTICS_SCRIPT, export, folder / "export.log", variables)
    part.replace(file)
    return file


class YoloPose:
    """Runs the network on the crops of both eyes."""

    def __init__(self, file: Path, threads: int) -> None:
        """Open a network of two crops.

        Raises:
            ValueError: the file is missing, or not a network of two crops with one class; the message names it.
        """
        self._session = open_session(file, threads)
        (entry,), (output,) = self._session.get_inputs(), self._session.get_outputs()
        self._input_name = entry.name
        _, channels, cells = output.shape if len(output.shape) == 3 else (0, 0, 0)
        # Networks of ultralytics with their own suppression of doubles have another, transposed output.
        if not cells > channels > _FIRST_KEYPOINT or (channels - _FIRST_KEYPOINT) % _KEYPOINT_CHANNELS:
            raise ValueError(f"{file}: must give a box, a score and keypoints in each cell, got {output.shape}")

    def keypoints(self, crops: Sequence[NDArray[np.uint8]]) -> list[Array | None]:
        """Keypoints (N, 2) in pixel-centre coordinates of each of two crops, None where no drogue is found. [px]"""
        (output,) = self._session.run(None, {self._input_name: network_input(crops)})
        return [best_keypoints(answer) for answer in output]


def best_keypoints(answer: NDArray[np.float32]) -> Array | None:
    """Keypoints (N, 2) of the best cell in pixel-centre coordinates, or None without a drogue. [px]

    Args:
        answer: (5 + 3 N, cells) of one crop, in corner coordinates. [px]
    """
    best = answer[:, int(np.argmax(answer[_SCORE_CHANNEL]))].astype(np.float64)
    if best[_SCORE_CHANNEL] < _LEAST_SCORE:
        return None
    points: Array = best[_FIRST_KEYPOINT:].reshape(-1, _KEYPOINT_CHANNELS)[:, :2] - 0.5
    return points
