"""The pairs in which the weights that a training starts from fail, to show them more often than others.

A drogue that has no box with a score of a half, and a box with one where no drogue is, are failures: most pairs have
none after a first training, and teach little more. Source: Shrivastava et al. 2016, arXiv:1604.03540, who choose hard
examples by their loss.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import write_text_atomic
from geometry.boxes import intersection_over_union
from geometry.se3 import Array
from nav.training.augmentation import SMALLEST_LEARNED_FRACTION, Boxes
from nav.training.corpus import Corpus
from nav.training.evaluation import Search, measure_batch_statistics, predict
from nav.training.training_progress import TrainingObserver
from nav.training.training_settings import TrainingSettings
from nav.training.training_state import ComputeDevice, StartingWeights, starting_network

HARD_PAIRS_FILE = "hard_pairs.json"
_SURE_SCORE, _MIN_IOU = 0.5, 0.5


def hard_pairs(
    out: Path,
    start: StartingWeights,
    corpus: Corpus,
    settings: TrainingSettings,
    compute: ComputeDevice,
    observer: TrainingObserver,
    should_stop: Callable[[], bool] = lambda: False,
) -> NDArray[np.int64]:
    """(n,) indices of the pairs of the split `train` in which the weights fail in either eye.

    They are looked for once, at the size of the first input, and then read from the training's folder.

    Args:
        out: the training's folder.
        start: the weights that the training starts from.
        corpus: with the images.
        settings: of the training.
        compute: device and precision.
        observer: is informed of the progress.
        should_stop: called after each batch.

    Raises:
        ValueError: the weights do not fit the network.
        OSError: the file in the folder cannot be written.
        KeyboardInterrupt: `should_stop` returned true.
    """
    path, pairs, size = out / HARD_PAIRS_FILE, corpus.split("train"), settings.size_at(0)
    searched = {
        "start_sha256": start.sha256,
        "datasets": [asdict(stamp) for stamp in corpus.datasets],
        "size_px": list(size),
    }
    known = _read(path, searched, pairs)
    if known is not None:
        return known

    def advance() -> None:
        observer.advance()
        if should_stop():
            raise KeyboardInterrupt

    network = starting_network(settings, start).to(compute.device).eval()
    if not start.need_batch_statistics:  # an exported file has them within its filters
        measure_batch_statistics(network, corpus, size, compute)
    batch = settings.batch_images
    observer.begin(f"batches of {batch} images in which the weights at the start may fail", -(-2 * len(pairs) // batch))
    try:
        seen = predict(network, corpus, "train", Search(size, batch, settings.large_from_px), compute, advance)
    finally:
        observer.end()
    smallest_px = SMALLEST_LEARNED_FRACTION * size[0]
    fails = [is_failure(own, *found, smallest_px) for own, found in zip(seen.truth, seen.found, strict=True)]
    hard = np.flatnonzero(np.reshape(fails, (-1, 2)).any(axis=1))
    write_text_atomic(path, json.dumps(searched | {"pairs": hard.tolist()}, indent=1) + "\n")
    return pairs[hard]


def is_failure(truth: Boxes, boxes: Boxes, scores: Array, smallest_px: float) -> bool:
    """Whether the boxes of an image with a score of at least a half miss a drogue, or are on none.

    Args:
        truth: (n, 4) boxes of the drogues.
        boxes, scores: (m, 4) boxes that were found, and their (m,) scores.
        smallest_px: drogues with a shorter longer side need not be found. [px]
    """
    sure = boxes[scores >= _SURE_SCORE]
    is_right = intersection_over_union(sure[:, None], truth[None]) >= _MIN_IOU
    sought = truth[:, 2:].max(axis=1, initial=0.0) >= smallest_px
    return not (is_right.any(axis=1).all() and is_right.any(axis=0)[sought].all())


def _read(path: Path, searched: dict[str, Any], pairs: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Those of some pairs that a file of the same search lists; None where it is missing, damaged or of another one."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if {key: found[key] for key in searched} == searched:
            hard: NDArray[np.int64] = pairs[np.array([int(place) for place in found["pairs"]], dtype=np.int64)]
            return hard
    except (OSError, ValueError, TypeError, KeyError, OverflowError, IndexError):
        pass
    return None
