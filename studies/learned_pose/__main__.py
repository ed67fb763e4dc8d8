"""`python -m studies.learned_pose`: trains keypoint networks and compares their poses with ours on the same frames.

Renders a corpus and a test set, trains YOLO26n-pose and a SimCC network, and prints tables; what is there is not made
again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from droguekit.batch.progress import progress_report
from droguekit.batch.render_dataset import render_dataset
from studies.detector_comparison.options import SeedOption, ThreadsOption, print_status
from studies.learned_pose.error_plot import write_error_plot
from studies.learned_pose.estimators import (
    ESTIMATORS,
    SIMCC,
    SIMCC_CPNP,
    SIMCC_STEREO,
    YOLO,
    YOLO_CPNP,
    YOLO_STEREO,
    KeypointSource,
    clear_simcc_keypoints,
    learned_poses,
    our_markers,
    our_poses,
    yolo_keypoints,
)
from studies.learned_pose.keypoint_corpus import eye_sample, keypoint_sigma_px, load_corpus
from studies.learned_pose.keypoint_training import SimccTraining, train_simcc
from studies.learned_pose.position_scores import PairScores, missing_lines, score_pair, table_lines
from studies.learned_pose.yolo_pose import YoloPose, YoloTraining, train_yolo
from studies.wrong_input import wrong_input_ends

_HERE = Path(__file__).parent
_TITLES = {
    "bound": "Position error over the bound of the stereo pair: median, 95th percentile",
    "cm": "Position error [cm]: median, 95th percentile",
    "deg": "Error of the axis [deg]: median, 95th percentile",
}


@dataclass(frozen=True)
class StudyOptions:
    """Options of the study.

    Attributes:
        workers: that render.
        yolo: training of YOLO26n-pose.
        simcc: training of the SimCC network.
    """

    workers: int
    yolo: YoloTraining
    simcc: SimccTraining


def compare(options: StudyOptions, out: Path) -> list[PairScores]:
    """Run every stage whose output does not exist yet, and score all estimators.

    Raises:
        ValueError: a dataset that cannot be read, or a folder of another study.
        OSError: a training failed, or a file cannot be written.
    """
    check_folder(options, out)
    for name in ("train", "test"):
        source = load_recipe(str(_HERE / f"{name}.toml"))
        print_status(f"{name}: {source.recipe.frames.count} pairs")
        render_dataset(source, out / name, range(source.recipe.frames.count), options.workers, progress_report())
    corpus = out / "train"
    yolo = YoloPose(train_yolo(corpus, out, options.yolo, print_status), options.yolo.threads)
    print_status(f"SimCC: {options.simcc.image_passes} image passes")
    simcc = train_simcc(partial(load_corpus, corpus, "train"), out / "simcc", options.simcc, print_status)
    validation = load_corpus(corpus, "val")
    sources = {}
    for name, find in (("YOLO26n-pose", yolo_keypoints(yolo)), ("SimCC", clear_simcc_keypoints(simcc))):
        sources[name] = KeypointSource(find, keypoint_sigma_px(find, validation))
        print_status(f"{name}: {sources[name].sigma_px:.3f} px of the crop, deviation of a coordinate in validation")
    test, pairs = Dataset(out / "test"), []
    for index in test.frame_indices:
        pairs.append(score_all(test.record(index), test.images(index), sources["YOLO26n-pose"], sources["SimCC"]))
    write_text_atomic(out / "errors.json", json.dumps([asdict(pair) for pair in pairs], indent=1) + "\n")
    return pairs


def check_folder(options: StudyOptions, out: Path) -> None:
    """Record the trainings in a new folder, and refuse one with other trainings.

    Raises:
        ValueError: the folder has networks of other options.
    """
    yolo, simcc = options.yolo, options.simcc
    trainings = {
        "yolo": {"image_passes": yolo.image_passes, "batch": yolo.batch, "seed": yolo.seed},
        "simcc": {"image_passes": simcc.image_passes, "batch": simcc.batch, "seed": simcc.seed},
    }
    file = out / "trainings.json"
    if file.exists():
        before = json.loads(file.read_text(encoding="utf-8"))
        if before != trainings:
            raise ValueError(f"{out}: holds other trainings, {before}; name a new folder")
        return
    out.mkdir(parents=True, exist_ok=True)
    write_text_atomic(file, json.dumps(trainings, indent=1) + "\n")


def score_all(record: PairRecord, images: StereoImages, yolo: KeypointSource, simcc: KeypointSource) -> PairScores:
    """All estimators on one pair, in the same boxes.

    Raises:
        ValueError: the pair shows no drogue.
    """
    frame, drogue = record.frame, record.frame.drogue
    if drogue is None:
        raise ValueError(f"frame {record.frame_index}: shows no drogue")
    layout, eyes = marker_layout(drogue), (eye_sample(record, images, "left"), eye_sample(record, images, "right"))
    poses = our_poses(our_markers(frame.rig, drogue, images, eyes))
    poses |= learned_poses(yolo.observe(frame.rig, layout, eyes), YOLO, YOLO_CPNP, YOLO_STEREO)
    poses |= learned_poses(simcc.observe(frame.rig, layout, eyes), SIMCC, SIMCC_CPNP, SIMCC_STEREO)
    return score_pair(record, {name: poses[name] for name in ESTIMATORS})


def hashes(out: Path) -> Mapping[str, str]:
    """The datasets' hashes by name."""
    return {name: Dataset(out / name).manifest.dataset_sha256 for name in ("train", "test")}


def main(
    out: Annotated[Path, typer.Option("--out", help="Folder; a stopped run goes on in it.")] = Path("out/learned-pose"),
    workers: Annotated[int, typer.Option("--workers", min=1, help="That render.")] = 1,
    yolo_passes: Annotated[int, typer.Option("--yolo-passes", min=1, help="Crops that YOLO26n-pose sees.")] = 14_400,
    simcc_passes: Annotated[int, typer.Option("--simcc-passes", min=1, help="Crops that SimCC sees.")] = 40_000,
    threads: ThreadsOption = 1,
    seed: SeedOption = 0,
    environment: Annotated[
        Path | None,
        typer.Option(
            "--environment", help="Virtual environment of ultralytics, made if missing; OUT/peers by default."
        ),
    ] = None,
) -> None:
    """Render, train, and print errors of all estimators by distance."""
    yolo = YoloTraining(yolo_passes, 16, threads, seed, environment or out / "peers")
    options = StudyOptions(workers, yolo, SimccTraining(simcc_passes, threads=threads, seed=seed))
    with wrong_input_ends("learned_pose"):
        pairs = compare(options, out)
        for name, digest in hashes(out).items():
            typer.echo(f"{name}: {digest}")
        for quantity, title in _TITLES.items():
            typer.echo("\n".join(("", f"{title}:", "", *table_lines(pairs, ESTIMATORS, quantity))))
        typer.echo("\n".join(("", *missing_lines(pairs, ESTIMATORS))))
        write_error_plot(pairs, out / "errors.png")
        typer.echo(f"wrote {out / 'errors.png'}")


if __name__ == "__main__":
    typer.run(main)
