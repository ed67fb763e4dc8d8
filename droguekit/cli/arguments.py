"""Arguments that several commands share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from datasets_manifest.storage.storage import Location, as_location
from droguekit.cli.main import FAULT
from render.device import Device

if TYPE_CHECKING:
    Place = Location
else:
    # typer knows no unions, and prints the names of types.
    Place = type("folder or URL", (), {})


def exit_with_fault(fault: str | None) -> None:
    """End the command with exit code 1 and the fault as one line; nothing where there is none."""
    if fault is not None:
        typer.echo(f"droguekit: error: {fault}", err=True)
        raise typer.Exit(FAULT)


def named_place(param: typer.CallbackParam, text: str | None) -> Location | None:
    """The callback of an argument or option of type `Place`, which has `parser=str`; None where it is not given.

    Raises:
        ValueError: an empty text, or a URL that names nothing; names the argument or option.
    """
    return None if text is None else _location(param, text)


def places(param: typer.CallbackParam, texts: list[str]) -> list[Location]:
    """The callback of an argument of type `list[Place]`, which has `parser=str`.

    Raises:
        ValueError: an empty text, or a URL that names nothing.
    """
    return [_location(param, text) for text in texts]


def _location(param: typer.CallbackParam, text: str) -> Location:
    if not text.strip():
        # An argument goes by the word that the help shows for it.
        name = param.opts[0] if param.param_type_name == "option" else str(param.metavar).rstrip(".")
        raise ValueError(f"{name}: must name a folder or a URL, got {text!r}")
    return as_location(text)


RecipeArgument = Annotated[str, typer.Argument(metavar="RECIPE", help="Name of a shipped recipe, or a .toml file.")]
DatasetArgument = Annotated[
    Place,
    typer.Argument(
        metavar="DIR",
        parser=str,
        callback=named_place,
        help="The dataset's folder, or a URL such as s3://BUCKET/NAME.",
    ),
]
OtherDatasetArgument = Annotated[
    Place,
    typer.Argument(metavar="OTHER", parser=str, callback=named_place, help="The dataset to compare it with, likewise."),
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
        help="A detector's name, or a network, perhaps with @HEIGHTxWIDTH of its input behind it; mobile-s by default. "
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
