"""Networks of ultralytics: their own virtual environment, training on our corpus, and use as detectors.

The environment is separate so that nothing of ours depends on ultralytics. The exported images are those that our own
networks see, with the drogue as the only class. The network runs like ours: same input image, same runtime, both eyes
in one batch.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from datasets_manifest.atomic import new_folder, write_text_atomic
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PixelBox
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, StereoDetection
from nav.detector.input_image import Letterbox, input_image, network_input

# torch as in our own environment. ultralytics is installed without its dependencies: opencv-python would need the
# libraries of a display, and torchvision need not even load, see `ultralytics_script`.
_TORCH = ("torch==2.13.0", "numpy>=1.26,<2", "onnx>=1.17")
_LIGHT = (
    *(
        "opencv-python-headless==4.11.0.86",
        "matplotlib>=3.9",
        "pillow>=10",
        "psutil>=5.9",
        "pyyaml>=6",
        "requests>=2.31",
    ),
    "polars>=1.0",
)
_WITHOUT_DEPENDENCIES = (
    "ultralytics==8.4.190",
    "ultralytics-thop==2.2.3",
    "ultralytics-platform==0.1.99",
    "torchvision==0.28.0",
)
_DONE = ".detector-peers"
SPLITS: tuple[SplitName, ...] = ("train", "val", "test")
PEERS = ("yolov8s", "yolov8n", "yolo11n", "yolo12n", "yolo26n")
"""Names of their configurations."""
_SCRIPT = Path(__file__).with_name("ultralytics_script.py")


def yolo_python(folder: Path, say: Callable[[str], None]) -> Path:
    """The Python interpreter of the environment in a folder; the environment is made if it is missing.

    Args:
        folder: of the environment.
        say: receives lines about the progress.

    Raises:
        OSError: no environment can be made, or the package index cannot be reached; the message names the log.
    """
    # Absolute, because other programs start in other folders.
    python = folder.resolve() / "bin" / "python"
    stamp, wanted = folder / _DONE, "\n".join((*_TORCH, *_LIGHT, *_WITHOUT_DEPENDENCIES)) + "\n"
    if stamp.exists() and stamp.read_text(encoding="utf-8") == wanted and python.exists():
        return python
    say(f"installing ultralytics into {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "install.log"
    log.unlink(missing_ok=True)
    _run_logged(
        [sys.executable, "-m", "venv", str(folder)], log, "no virtual environment can be made; install python3-venv"
    )
    install = [str(python), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    fault = "pip could not install it; is the package index within reach?"
    _run_logged([*install, *_TORCH, *_LIGHT], log, fault)
    _run_logged([*install, "--no-deps", *_WITHOUT_DEPENDENCIES], log, fault)
    write_text_atomic(stamp, wanted)
    return python


def yolo_environment_variables(folder: Path, threads: int) -> dict[str, str]:
    """Environment variables that keep ultralytics from downloading, and from writing settings elsewhere.

    Args:
        folder: for its settings.
        threads: number of threads that it may use.
    """
    quiet = {"YOLO_CONFIG_DIR": str(folder.resolve()), "YOLO_AUTOINSTALL": "false", "YOLO_OFFLINE": "true"}
    counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    return {**os.environ, **quiet, **counts, "PYTHONUNBUFFERED": "1"}


def _run_logged(command: list[str], log: Path, fault: str) -> None:
    with log.open("a", encoding="utf-8") as stream:
        ended = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, check=False)
    if ended.returncode != 0:
        raise OSError(f"{log.parent}: {fault} The whole output is in {log}")


def check_corpus(corpus: Path, test: Path) -> None:
    """Check that datasets have the pairs to train, validate and score with, and share no scenes.

    Args:
        corpus: needs pairs to train on and to validate with.
        test: needs pairs to score; may be the corpus.

    Raises:
        ValueError: a dataset cannot be read or lacks a split, or both have the same seed and so the same scenes.
    """
    needed: dict[Path, tuple[SplitName, ...]] = {corpus: ("train", "val")}
    needed[test] = (*needed.get(test, ()), "test")
    manifests = {dataset: Dataset(dataset).manifest for dataset in needed}
    for dataset, splits in needed.items():
        counts = manifests[dataset].counts.by_split
        if not all(counts.get(split) for split in splits):
            raise ValueError(f"{dataset}: needs pairs in the splits {', '.join(splits)}, got {dict(counts)}")
    seeds = {manifest.recipe.seed for manifest in manifests.values()}
    if len(seeds) < len(needed):
        raise ValueError(
            f"{test}: has scenes of {corpus}, for both have the seed {min(seeds)}; render one with another seed, "
            "or leave --test away to score the corpus's own split"
        )


def export_corpus(corpus: Path, out: Path, size_px: tuple[int, int]) -> Path:
    """Write images and boxes, unless they exist already.

    Args:
        corpus: a dataset.
        out: folder.
        size_px: width and height of the images. They are made like our networks' input, because ultralytics would
            resize them in another way.

    Returns:
        The file `data.yaml`.

    Raises:
        ValueError: the corpus cannot be read.
        OSError: the folder cannot be written; no partial folder is left.
    """
    data = out / "data.yaml"
    if data.exists():
        return data
    source = Dataset(corpus)
    splits = source.manifest.split_of_frame()
    with new_folder(out) as folder:
        for split in SPLITS:
            for kind in ("images", "labels"):
                (folder / kind / split).mkdir(parents=True)
        for index in source.frame_indices:
            record, images = source.record(index), source.images(index)
            for eye in EYES:
                image, placement = input_image(images, eye, size_px)
                name = f"{splits[index]}/{index:06d}_{eye}"
                (folder / "images" / f"{name}.png").write_bytes(encode_png(image))
                view = record.views.left if eye == "left" else record.views.right
                # Drogues of other tankers are boxes for us too, in training and in the scores.
                boxes = [view.box_visible_xywh_px, *(other.box_visible_xywh_px for other in view.neighbours)]
                rows = "".join(_row(box, placement, size_px) for box in boxes if box is not None)
                (folder / "labels" / f"{name}.txt").write_text(rows, encoding="utf-8")
        lines = "".join(f"{split}: images/{split}\n" for split in SPLITS)
        (folder / "data.yaml").write_text(f'path: ""\n{lines}names:\n  0: drogue\n', encoding="utf-8")
    return data


def training_image_count(corpus: Path) -> int:
    """Number of images of an epoch: both eyes of every pair of the split `train`.

    Raises:
        ValueError: the corpus cannot be read.
    """
    return 2 * Dataset(corpus).manifest.counts.by_split.get("train", 0)


def _row(box_px: PixelBox, placement: Letterbox, size_px: tuple[int, int]) -> str:
    """Class, centre and size of an image's box, as fractions of the image's size."""
    x, y, width, height = placement.to_input(np.array([box_px]))[0].tolist()
    fractions = [(x + width / 2) / size_px[0], (y + height / 2) / size_px[1], width / size_px[0], height / size_px[1]]
    return f"0 {' '.join(map(repr, fractions))}\n"


def run_script(python: Path, task: Mapping[str, Any], log: Path, variables: Mapping[str, str]) -> None:
    """Run a task of `ultralytics_script` in the peers' environment, with its output in a log.

    Raises:
        OSError: it failed; the message has the last line of the output, and names the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        ended = subprocess.run(
            # -P: a file in the working folder must not replace a module of ultralytics.
            [str(python), "-P", str(_SCRIPT)],
            input=json.dumps(task),
            text=True,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=dict(variables),
            cwd=log.parent,
            check=False,
        )
    if ended.returncode != 0:
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        raise OSError(f"{log}: ultralytics ended with status {ended.returncode}: {lines[-1] if lines else 'silently'}")


class TrainingLength(NamedTuple):
    """The length of a training by ultralytics.

    Attributes:
        epochs: number of epochs.
        fraction: of the images, in each epoch.
        image_passes: number of image passes that result.
    """

    epochs: int
    fraction: float
    image_passes: int


def training_length(image_passes: int, images: int) -> TrainingLength:
    """The length whose number of image passes is nearest to the given one.

    ultralytics trains whole epochs, and a fraction of the images would be the same images in every epoch. So passes are
    rounded to whole epochs of all images; only a training of less than one epoch leaves images out.

    Raises:
        ValueError: no images.
    """
    if images < 1:
        raise ValueError("corpus: has no images to train on")
    epochs, fraction = max(1, round(image_passes / images)), min(1.0, image_passes / images)
    return TrainingLength(epochs, fraction, epochs * round(fraction * images))


# Defaults of ultralytics: IoU of its non-maximum suppression, largest number of boxes, and score threshold.
_MAX_IOU = 0.7
_MAX_BOXES = 300
_DEFAULT_THRESHOLD = 0.25
# Networks that suppress doubles themselves answer with corners, score and class, the best first.
_CORNER_COLUMNS = 6


def open_session(file: Path, threads: int) -> onnxruntime.InferenceSession:
    """Open a network whose idle threads do not spin, so that other detectors are not slowed while they are timed.

    Raises:
        ValueError: the file is missing or not an ONNX network; the message names it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror}") from error
    except Exception as error:  # onnxruntime's exceptions have no other common base
        raise ValueError(f"{file}: is not an ONNX network: {str(error).splitlines()[0]}") from error


class YoloDetector:
    """Runs a network on both images of a pair in one batch.

    Attributes:
        name: how it is called in results.
        input_size_px: width, height. [px]
    """

    def __init__(self, file: Path, threads: int) -> None:
        """Open a network of two images.

        Raises:
            ValueError: the file is missing, or not a network of two images with one class; the message names it.
        """
        self.name = file.stem
        self._session = open_session(file, threads)
        (entry,), (output,) = self._session.get_inputs(), self._session.get_outputs()
        shape, rows = entry.shape, output.shape
        if len(shape) != 4 or shape[:2] != [len(EYES), 3] or len(rows) != 3:
            raise ValueError(f"{file}: must take two images and give rows of boxes, got {shape} and {rows}")
        self._input_name = entry.name
        self.input_size_px = (int(shape[3]), int(shape[2]))

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, if it reaches the default threshold of ultralytics."""
        found = self.candidates(images, _DEFAULT_THRESHOLD)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes of each image after non-maximum suppression, the best first."""
        inputs, placements = zip(*(input_image(images, eye, self.input_size_px) for eye in EYES), strict=True)
        (output,) = self._session.run(None, {self._input_name: network_input(inputs)})
        found: dict[Eye, tuple[Detection, ...]] = {}
        for eye, placement, rows in zip(EYES, placements, output, strict=True):
            decode = decode_corners if rows.shape[1] == _CORNER_COLUMNS else decode_rows
            boxes, scores = decode(rows, least_score)
            found[eye] = tuple(
                Detection((x, y, width, height), score)
                for (x, y, width, height), score in zip(
                    placement.to_image(boxes).tolist(), scores.tolist(), strict=True
                )
            )
        return found


def decode_rows(rows: NDArray[np.float32], least_score: float) -> tuple[Array, Array]:
    """Decode the boxes and scores of one image.

    Args:
        rows: (4 + classes, n) centre x, y, width, height in corner coordinates of the input, and the scores of the
            classes, of which the first is the drogue.
        least_score: boxes with a lower score are left out.

    Returns:
        (m, 4) low corner, width, height, and (m,) scores, descending.
    """
    scores = rows[4].astype(np.float64)
    keep = np.flatnonzero(scores >= least_score)
    center, size = rows[:2, keep].T.astype(np.float64), rows[2:4, keep].T.astype(np.float64)
    boxes, scores = np.hstack((center - size / 2, size)), scores[keep]
    if len(boxes):
        stay = np.asarray(cv2.dnn.NMSBoxes(boxes.tolist(), scores.tolist(), 0.0, _MAX_IOU), dtype=np.intp)
        stay = stay[np.argsort(-scores[stay], kind="stable")][:_MAX_BOXES]
        boxes, scores = boxes[stay], scores[stay]
    return boxes, scores


def decode_corners(rows: NDArray[np.float32], least_score: float) -> tuple[Array, Array]:
    """Decode the boxes and scores of one image of a network that needs no suppression, such as YOLO26.

    Args:
        rows: (n, 6) low and high corner in coordinates of the input, score, class.
        least_score: boxes with a lower score are left out.

    Returns:
        (m, 4) low corner, width, height, and (m,) scores, descending.
    """
    kept = rows[rows[:, 4] >= least_score].astype(np.float64)
    kept = kept[np.argsort(-kept[:, 4], kind="stable")]
    return np.hstack((kept[:, :2], kept[:, 2:4] - kept[:, :2])), kept[:, 4]
