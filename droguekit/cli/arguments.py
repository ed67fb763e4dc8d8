"""Arguments that several commands share."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from datasets_manifest.storage.storage import Location, as_location
from droguekit.cli.main import FAULT
from render.device import Device

if TYPE_CHECKING:
    Place = Location
else:
    # typer knows no unions, and prints the names of types.
    Place = type("folder or URL", (), {})


def output_option(name: str, metavar: str, help: str) -> Any:
    """An option of type `Path` for an output file or folder on this machine.

    A URL, and a place that cannot be written, are refused before the command does its work.
    """
    return typer.Option(name, metavar=metavar, parser=str, callback=_local_path, help=help)


def _local_path(option: typer.CallbackParam, text: str | None) -> Path | None:
    if text is None:
        return None
    if "://" in text:
        raise ValueError(f"{option.opts[0]}: must be a folder or file of this machine, got {text}")
    path, is_folder = Path(text), str(option.metavar).startswith("DIR")
    try:
        if not is_folder and path.is_dir():
            raise ValueError(f"{option.opts[0]}: must be a file, got the folder {path}")
        reason = _why_unwritable(path, is_folder)
    except OSError as error:  # a name that is too long, or a folder that nobody may look into
        reason = error.errno
    if reason is not None:
        raise OSError(f"{path}: cannot be written: {os.strerror(reason)}")
    return path


def _why_unwritable(path: Path, is_folder: bool) -> int | None:
    """The error's number of a place that surely cannot be written; None where it may succeed."""
    if path.exists():
        if is_folder and not path.is_dir():
            return errno.ENOTDIR
        if not is_folder and not path.is_file():
            return None  # a device or pipe, which is opened and not replaced
    folder = path if is_folder else path.parent
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        return errno.ENOTDIR
    return None if os.access(folder, os.W_OK | os.X_OK) else errno.EACCES


def exit_with_fault(fault: str | None) -> None:
    """End the command with exit code 1 and the fault as one line; nothing where there is none."""
    if fault is not None:
        typer.echo(f"droguekit: error: {fault}", err=True)
        raise typer.Exit(FAULT)


def places(texts: list[str]) -> list[Location]:
    """The callback of an argument of type `list[Place]`, which has `parser=str`.

    Raises:
        ValueError: a URL that names nothing.
    """
    return [as_location(text) for text in texts]


RecipeArgument = Annotated[str, typer.Argument(metavar="RECIPE", help="Name of a shipped recipe, or a .toml file.")]
DatasetArgument = Annotated[
    Place,
    typer.Argument(
        metavar="DIR",
        parser=str,
        callback=as_location,
        help="The dataset's folder, or a URL such as s3://BUCKET/NAME.",
    ),
]
OtherDatasetArgument = Annotated[
    Place,
    typer.Argument(metavar="OTHER", parser=str, callback=as_location, help="The dataset to compare it with, likewise."),
]
TarOption = Annotated[
    int | None,
    typer.Option(
        "--tar",
        metavar="N",
        help="Keep pairs in tar files of N pairs instead of a folder each; cannot be changed later.",
    ),
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Replaces the recipe's seed.")]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        help="Worker processes; by default as many as cores and memory allow. 0 runs in this process, for debugging.",
    ),
]
PositiveWorkersOption = Annotated[
    int | None,
    typer.Option("--workers", help="Worker processes, at least 1; by default as many as cores and memory allow."),
]
DetectorOption = Annotated[
    str | None,
    typer.Option(
        "--detector",
        metavar="NAME|FILE.onnx",
        help="A detector's name, or a network, perhaps with @HEIGHTxWIDTH of its input behind it; "
        "docs/reference/detectors.md.",
    ),
]
EngineOption = Annotated[str | None, typer.Option("--engine", metavar="NAME", help="Replaces the recipe's engine.")]
DeviceOption = Annotated[
    Device,
    typer.Option(
        "--device", help="What to render on: the processor, or an NVIDIA GPU; docs/how-to/render-on-a-gpu.md."
    ),
]


def parse_frames(text: str | None, count: int) -> range:
    """The frames of `A:B`, from A up to but not including B; either may be omitted, and None means all.

    Raises:
        ValueError: another form, or frames outside the recipe.
    """
    if text is None:
        return range(count)
    low, colon, high = text.partition(":")
    if not colon or not all(part.isdecimal() or part == "" for part in (low, high)):
        raise ValueError(f"--frames: must be A:B with whole numbers, such as 0:100, got {text!r}")
    first, last = int(low or 0), int(high or count)
    if not first < last <= count:
        raise ValueError(f"--frames: must name frames of the recipe's {count}, at least one, got {text!r}")
    return range(first, last)


def parse_shard(text: str | None, frames: range) -> range:
    """Every n-th frame, starting with the i-th, for `i/n`; None means all.

    Consecutive frames go to different shards, so that all shards take about as long.

    Raises:
        ValueError: another form, or a shard without frames.
    """
    if text is None:
        return frames
    low, slash, high = text.partition("/")
    if not slash or not low.isdecimal() or not high.isdecimal() or not int(low) < int(high):
        raise ValueError(f"--shard: must be i/n with i from 0 to n - 1, such as 0/4, got {text!r}")
    shard = frames[int(low) :: int(high)]
    if not shard:
        raise ValueError(f"--shard: {text} has none of the {len(frames)} frames; take fewer shards")
    return shard
