"""A training from datasets to an exported network, in a folder in which it can be interrupted and resumed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import onnx
import torch

from datasets_manifest.atomic import try_lock, write_text_atomic
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.storage import Location
from nav.detector.model_metadata import ModelMetadata
from nav.detector.network.network import DetectorNetwork
from nav.detector.onnx_detector import OnnxDetector
from nav.training.corpus import Corpus, open_corpus
from nav.training.evaluation import (
    DEFAULT_THRESHOLD,
    Predictions,
    ValidationScores,
    average_precision,
    best_threshold,
    detect_split,
    measure_batch_statistics,
    statistics_batches,
)
from nav.training.hard_pairs import hard_pairs
from nav.training.onnx_conversion import recalibrate_batch_norm, trace_onnx, write_onnx
from nav.training.trainer import NO_PAIRS, Trainer
from nav.training.training_progress import TrainingObserver
from nav.training.training_settings import TrainingSettings, size_text
from nav.training.training_state import (
    BEST_FILE,
    ComputeDevice,
    MovingAverage,
    StartingWeights,
    TrainingState,
    check_settings,
    limit_threads,
    load_checkpoint,
    new_network,
    new_state,
    open_compute_device,
    remove_partial_files,
    restore_state,
    settings_from_start,
    starting_network,
)

SETTINGS_FILE, RESULT_FILE, ONNX_FILE, LAST_ONNX_FILE = "settings.json", "result.json", "detector.onnx", "last.onnx"
_LOCK_FILE = ".lock"
_NO_CPU_MEMORY = "DefaultCPUAllocator: can't allocate memory"


@dataclass(frozen=True)
class TrainingResult:
    """The result of a training.

    Attributes:
        file: the exported network.
        best_step: the step whose averaged weights it has.
        validation, test: scores on these splits; None for a split without a drogue.
        score_threshold: a box with a lower score is not a drogue.
        fault: damaged pairs, which were left out, as one line; None for nothing.
    """

    file: Path
    best_step: int
    validation: ValidationScores | None
    test: ValidationScores | None
    score_threshold: float
    fault: str | None = None


def train(
    datasets: Sequence[Location],
    out: Path,
    settings: TrainingSettings,
    observer: TrainingObserver,
    cache: Path | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    start: StartingWeights | None = None,
    photographs: Path | None = None,
) -> TrainingResult:
    """Train, evaluate on the split `test` and export; a training that was interrupted in this folder is resumed.

    Args:
        datasets: folders or URLs.
        out: folder; made if missing.
        settings: of the training.
        observer: is informed of the progress.
        cache: folder of the image caches; `out / "cache"` by default.
        should_stop: called after every step.
        start: weights to start from instead of random ones.
        photographs: folder of pictures without a drogue to train on beside the datasets, or None.

    Raises:
        ValueError: a dataset or photograph that cannot be used, a device that is not available, weights of another
            network, a folder of another training, or one that another run uses, or too little memory for a batch; the
            message names the path or setting.
        OSError: a file cannot be written.
        KeyboardInterrupt: `should_stop` returned true; the state is saved, and the same call resumes the training.
    """
    settings = settings_from_start(settings, start)
    compute = open_compute_device(settings)
    _check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out), limit_threads(settings.threads), _lack_of_memory_told(settings, compute):
        remove_partial_files(out)
        size, threads = settings.largest_size_px, settings.loader_workers
        corpus = open_corpus(datasets, cache or out / "cache", size, threads, observer, should_stop, photographs)
        state = new_state(starting_network(settings, start), settings, compute)
        is_resumed = restore_state(out, state, settings, corpus.datasets)
        if start is not None and start.need_batch_statistics and not is_resumed:
            _recalibrate_start(state, corpus, settings, compute)
        _load_best(out, state)
        write_text_atomic(out / SETTINGS_FILE, json.dumps(settings.model_dump(mode="json"), indent=1) + "\n")
        observer.say(_summary(corpus, settings, compute, state))
        hard = NO_PAIRS
        if start is not None and settings.hard_fraction:
            hard = hard_pairs(out, start, corpus, settings, compute, observer, should_stop)
            observer.say(
                f"the weights at the start fail in {len(hard)} of {len(corpus.split('train'))} pairs to train on"
            )
        Trainer(corpus, settings, compute, out, observer, should_stop, hard).run(state)
        evaluator = _Evaluator(corpus, settings, compute, observer, should_stop)
        return _evaluate_and_export(out, state, evaluator)


def check_training(out: Path, settings: TrainingSettings, start: StartingWeights | None = None) -> None:
    """Check everything about a training that does not need its datasets.

    Raises:
        ValueError: a device that is not available, weights of another network, a folder of a training with other
            settings, or one that another run uses.
    """
    settings = settings_from_start(settings, start)
    compute = open_compute_device(settings)
    new_state(starting_network(settings, start), settings, compute)
    _check_folder(out)
    if out.exists():
        with _locked(out):
            check_settings(out, settings)


def _check_folder(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is a file; give a folder for the training")


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    with (out / _LOCK_FILE).open("a") as lock:
        if not try_lock(lock):
            raise ValueError(f"{out}: another training is running in it; wait for its end, or give another folder")
        yield


@contextmanager
def _lack_of_memory_told(settings: TrainingSettings, compute: ComputeDevice) -> Iterator[None]:
    """Turn a lack of memory, which numpy and torch tell in their own ways, into one line."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # Torch has no class of its own for the CPU's memory.
        if not isinstance(error, MemoryError | torch.OutOfMemoryError) and _NO_CPU_MEMORY not in str(error):
            raise
        raise ValueError(
            f"batch_images: {settings.batch_images} images of {size_text(settings.largest_size_px)} need more memory "
            f"than {compute.device.type} has left; train with fewer or smaller ones, into another folder"
        ) from error


def _recalibrate_start(
    state: TrainingState, corpus: Corpus, settings: TrainingSettings, compute: ComputeDevice
) -> None:
    """Measure batch statistics for the weights of an exported file, before the first step."""
    exact = ComputeDevice(compute.device, bf16=False)
    recalibrate_batch_norm(state.network, statistics_batches(corpus, settings.size_at(0), exact))
    state.average = MovingAverage(state.network, settings.ema_decay)


def _summary(corpus: Corpus, settings: TrainingSettings, compute: ComputeDevice, state: TrainingState) -> str:
    pairs = {split: len(corpus.split(split)) for split in ("train", "val", "test")}
    weights = sum(each.numel() for each in state.network.parameters())
    photographs = len(corpus.photographs)
    beside = f", {photographs} cut-outs of photographs" if photographs else ""
    done = f", resumed after {state.step * settings.batch_images:,}" if state.step else ""
    return (
        f"{settings.variant}, {settings.attention}, {settings.fusion}: {weights / 1e6:.2f} million weights; "
        f"{pairs['train']} pairs to train on{beside}, {pairs['val']} to validate, {pairs['test']} to test; "
        f"{settings.image_passes:,} images{done}; {compute.device.type}, {'bf16' if compute.bf16 else 'float32'}"
    )


@dataclass(frozen=True, eq=False)
class _Evaluator:
    """Evaluates networks of a training as the detectors that users get from them."""

    corpus: Corpus
    settings: TrainingSettings
    compute: ComputeDevice
    observer: TrainingObserver
    should_stop: Callable[[], bool]

    def evaluate(
        self, network: DetectorNetwork, step: int, file: Path, has_test: bool
    ) -> tuple[TrainingResult, onnx.ModelProto]:
        """The threshold and the scores of the detector that a network is exported as, and the model to export.

        Args:
            network: on the training's device; its batch statistics are measured.
            step: after which it had these weights.
            file: that it will be exported to.
            has_test: whether to score the split `test` too.
        """
        # The exported files compute in float32.
        exact = ComputeDevice(self.compute.device, bf16=False)
        measure_batch_statistics(network, self.corpus, self.settings.size_at(self.settings.steps - 1), exact)
        result = TrainingResult(file, step, None, None, DEFAULT_THRESHOLD)
        model = trace_onnx(network)
        with TemporaryDirectory() as folder:
            trial = Path(folder) / file.name
            write_onnx(model, trial, _metadata(result, self.corpus, self.settings, network))
            detector = OnnxDetector(trial, threads=torch.get_num_threads())
        validation = self._detect(detector, "val")
        threshold = best_threshold(validation.truth, validation.found, DEFAULT_THRESHOLD)
        detector.metadata = replace(detector.metadata, score_threshold=threshold)
        if self.settings.small_below_px:
            # Which boxes are certain, and so not looked at again, depends on the threshold.
            validation = self._detect(detector, "val")
        test = self._detect(detector, "test") if has_test else Predictions([], [])
        scored = replace(
            result,
            validation=average_precision(validation.truth, validation.found),
            test=average_precision(test.truth, test.found),
            score_threshold=threshold,
        )
        return scored, model

    def _detect(self, detector: OnnxDetector, split: SplitName) -> Predictions:
        def advance() -> None:
            self.observer.advance()
            if self.should_stop():
                raise KeyboardInterrupt

        self.observer.begin(f"pairs of the split {split} in which the detector searches", len(self.corpus.split(split)))
        try:
            return detect_split(detector, self.corpus, split, advance)
        finally:
            self.observer.end()


def _evaluate_and_export(out: Path, state: TrainingState, evaluator: _Evaluator) -> TrainingResult:
    """Evaluate and export the best weights, and the last ones too."""
    corpus, settings = evaluator.corpus, evaluator.settings
    best_step, best = _best_network(out, settings, state)
    result, model = evaluator.evaluate(best.to(evaluator.compute.device), best_step, out / ONNX_FILE, has_test=True)
    write_text_atomic(
        out / RESULT_FILE, json.dumps(_result_table(result, corpus, settings), indent=1, allow_nan=False) + "\n"
    )
    write_onnx(model, out / ONNX_FILE, _metadata(result, corpus, settings, best))
    last, of_last = best, result
    if state.step != best_step:
        last = state.average.network
        of_last, model = evaluator.evaluate(last, state.step, out / LAST_ONNX_FILE, has_test=False)
    write_onnx(model, out / LAST_ONNX_FILE, _metadata(of_last, corpus, settings, last))
    return replace(result, fault=corpus.fault)


def _metadata(
    result: TrainingResult, corpus: Corpus, settings: TrainingSettings, network: DetectorNetwork
) -> ModelMetadata:
    height_px, width_px = settings.size_at(settings.steps - 1)
    return ModelMetadata(
        input_size_px=(width_px, height_px),
        score_threshold=result.score_threshold,
        large_from_px=settings.large_from_px,
        small_below_px=settings.small_below_px,
        licence=settings.licence,
        manifest_sha256=corpus.datasets[0].manifest_sha256 if len(corpus.caches) == 1 else "",
        network=network.config.to_dict(),
        training=_result_table(result, corpus, settings),
    )


def _best_network(out: Path, settings: TrainingSettings, state: TrainingState) -> tuple[int, DetectorNetwork]:
    """Step and network of the averaged weights that were best on the validation split; without one, of the last."""
    network = new_network(settings).eval()
    saved = _load_best(out, state)
    if saved is None:
        network.load_state_dict(state.average.network.state_dict())
        return state.step, network
    try:
        network.load_state_dict(saved["network"])
        return int(saved["step"]), network
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{out / BEST_FILE}: does not fit this network; train into another folder") from error


def _load_best(out: Path, state: TrainingState) -> dict[str, Any] | None:
    """Read the best weights so far; None where no epoch was validated yet.

    Raises:
        ValueError: their file is missing or damaged.
    """
    if state.best[0] < 0:
        return None
    saved = load_checkpoint(out / BEST_FILE)
    if saved is None:
        raise ValueError(
            f"{out / BEST_FILE}: is missing, with the best weights so far; restore it, or train into another folder"
        )
    return saved


def _result_table(result: TrainingResult, corpus: Corpus, settings: TrainingSettings) -> dict[str, Any]:
    """Plain JSON about the training, for `result.json` and the metadata of the exported file."""
    return {
        "datasets": [asdict(stamp) for stamp in corpus.datasets],
        "settings": settings.model_dump(mode="json"),
        "image_passes": settings.steps * settings.batch_images,
        "best_after_image_passes": result.best_step * settings.batch_images,
        "score_threshold": result.score_threshold,
        "validation": None if result.validation is None else asdict(result.validation),
        "test": None if result.test is None else asdict(result.test),
    }
