"""`droguekit train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import WorkersOption, output_option
from droguekit.workflows.detection import TrainingOptions, train_detector, training_lines

EXAMPLES = (
    "droguekit train detector-small --out out/detector   (renders the recipe first)",
    "droguekit train data/mine data/more --out out/mine --variant s --image-passes 20000 --size 320x416",
    "droguekit train data/mine --out out/mine --size 320x416 --final-size 480x640   (large images in the last half)",
    "droguekit train data/mine --out out/mine --start-from mobile-s --image-passes 8000   (from the shipped weights)",
    "droguekit train data/mine --out out/mine --settings mine.toml   (learning rate, batch, seed and so on)",
)


def train(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="Datasets (folders or URLs) and recipes (shipped or .toml; rendered into OUT/datasets).",
        ),
    ],
    out: Annotated[Path, output_option("--out", "DIR", "The training's folder; made if missing.")],
    variant: Annotated[Literal["l", "s"] | None, typer.Option("--variant", help="Large or small network.")] = None,
    attention: Annotated[Literal["eca", "se"] | None, typer.Option("--attention", help="Channel attention.")] = None,
    fusion: Annotated[
        Literal["asff", "concat"] | None, typer.Option("--fusion", help="Fusion of the three scales.")
    ] = None,
    mosaic: Annotated[
        bool | None, typer.Option("--mosaic/--no-mosaic", help="Mosaic of four images; on by default.")
    ] = None,
    views: Annotated[
        Literal["one", "both"] | None, typer.Option("--views", help="Eyes of a pair in one batch; both by default.")
    ] = None,
    image_passes: Annotated[
        int | None, typer.Option("--image-passes", help="Images in total; 40,000 by default.")
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="HxW", help="Input size, multiples of 32; 480x640 by default.")
    ] = None,
    final_size: Annotated[
        str | None, typer.Option("--final-size", metavar="HxW", help="Input size in the last half; --size by default.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of weights and augmentation; 0 by default.")] = None,
    device: Annotated[
        Literal["cpu", "cuda"] | None, typer.Option("--device", help="Device to train on; cpu by default.")
    ] = None,
    threads: Annotated[int | None, typer.Option("--threads", help="Threads; as many as cores by default.")] = None,
    settings: Annotated[
        Path | None, typer.Option("--settings", metavar="FILE", help="TOML of settings, which options here override.")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option("--cache", metavar="DIR", help="For resized images; OUT/cache by default.")
    ] = None,
    start_from: Annotated[
        str | None,
        typer.Option(
            "--start-from",
            metavar="NAME|FILE",
            help="Initial weights: mobile-s, mobile-l, an .onnx of droguekit, or best.pt of a training.",
        ),
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Train a detector on datasets, evaluate it on their test splits, and export it as ONNX.

    Run again, the same command continues where it stopped. Ctrl-C saves and stops; a second Ctrl-C stops at once.
    """
    changes = {
        "variant": variant,
        "attention": attention,
        "fusion": fusion,
        "mosaic": mosaic,
        "views": views,
        "image_passes": image_passes,
        "seed": seed,
        "device": device,
        "threads": threads,
    }
    options = TrainingOptions(tuple(sources), settings, changes, size, final_size, cache, start_from, workers)
    for line in training_lines(train_detector(options, out, progress_report())):
        typer.echo(line)
