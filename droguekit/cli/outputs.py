"""Options for output files and folders, and the check that a command does not write over what it reads."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path, PosixPath
from typing import Any

import typer
from typer.core import TyperCommand

from datasets_manifest.atomic import is_stream
from datasets_manifest.storage import layout

# What a dataset's folder holds of its own; a report may lie beside it.
_OF_DATASETS = {
    layout.RECIPE_FILE,
    layout.MANIFEST_FILE,
    layout.CARD_FILE,
    layout.CROISSANT_FILE,
    layout.BLIND_FILE,
    layout.EVENTS_FILE,
    layout.FRAMES_FOLDER,
    layout.SHARDS_FOLDER,
    layout.ANNOTATIONS_FOLDER,
    layout.CALIBRATION_FOLDER,
    layout.MESHES_FOLDER,
}


class OutputPath(PosixPath):
    """A file or folder that a command writes, by an option from `output_option`."""


class CheckedCommand(TyperCommand):
    """A command that refuses to write over what it reads, before it does anything."""

    def invoke(self, ctx: typer.Context) -> Any:  # type: ignore[override]
        """Run the command with its parameters."""
        check_outputs({_option_of(self, name): value for name, value in ctx.params.items()})
        return super().invoke(ctx)


def output_option(name: str, metavar: str, help: str) -> Any:
    """An option of type `Path` for an output file or folder on this machine.

    A URL, and a place that cannot be written, are refused before the command does its work.
    """
    return typer.Option(name, metavar=metavar, parser=str, callback=_local_path, help=help)


def check_outputs(parameters: Mapping[str, Any]) -> None:
    """Check that no output is another output or an input of the same command.

    Args:
        parameters: values by the names that a user knows, outputs as `OutputPath`.

    Raises:
        ValueError: two outputs are one file, or an output is a file that the command reads, a dataset that it reads or
            a part of one.
    """
    outputs = {name: value for name, value in parameters.items() if isinstance(value, OutputPath)}
    places = {name: path.resolve() for name, path in outputs.items() if not is_stream(path)}
    for (one, place), (other, second) in combinations(places.items(), 2):
        if place == second:
            raise ValueError(f"{other}: must be another file than {one}, got {outputs[other]}")
    inputs = [
        (name, each)
        for name, value in parameters.items()
        if name not in outputs
        for each in _existing(value, is_argument=not name.startswith("-"))
    ]
    for name, place in places.items():
        for source, read in inputs:
            if place == read:
                raise ValueError(f"{name}: is what {source} reads; name another place than {outputs[name]}")
            if _is_dataset(read) and place.is_relative_to(read) and place.relative_to(read).parts[0] in _OF_DATASETS:
                raise ValueError(f"{name}: is a part of the dataset {read}; name another place than {outputs[name]}")


def _option_of(command: TyperCommand, name: str) -> str:
    """What a user calls a parameter: its option, or the word in the usage."""
    for parameter in command.params:
        if parameter.name == name:
            option = max(parameter.opts, key=len)
            return option if option.startswith("-") else str(parameter.metavar or name)
    return name


def _existing(value: Any, is_argument: bool) -> Iterator[Path]:
    """The files and folders of this machine that a parameter names; texts of options are names of other things."""
    if isinstance(value, list | tuple):
        for each in value:
            yield from _existing(each, is_argument)
    elif isinstance(value, Path) or (is_argument and isinstance(value, str)):
        try:
            path = Path(value).resolve()
            if path.exists():
                yield path
        except (OSError, ValueError):  # no path at all, such as a long text
            return


def _is_dataset(folder: Path) -> bool:
    return any((folder / name).exists() for name in (layout.MANIFEST_FILE, layout.BLIND_FILE, layout.FRAMES_FOLDER))


def _local_path(option: typer.CallbackParam, text: str | None) -> Path | None:
    if text is None:
        return None
    if "://" in text:
        raise ValueError(f"{option.opts[0]}: must be a folder or file of this machine, got {text}")
    if not text:
        raise ValueError(f"{option.opts[0]}: must name a place, got an empty text")
    path, is_folder = OutputPath(text), str(option.metavar).startswith("DIR")
    try:
        if not is_folder and path.is_dir():
            raise ValueError(f"{option.opts[0]}: must be a file, got the folder {path}")
        if path.is_symlink() and not is_folder and not is_stream(path):
            path = OutputPath(path.resolve())  # the file is replaced, and not the link
        reason = _why_unwritable(path, is_folder)
    except OSError as error:  # a name that is too long, or a folder that nobody may look into
        reason = error.errno
    if reason is not None:
        raise OSError(f"{path}: cannot be written: {os.strerror(reason)}")
    return path


def _why_unwritable(path: Path, is_folder: bool) -> int | None:
    """The error's number of a place that surely cannot be written; None where it may succeed."""
    if is_folder and path.exists() and not path.is_dir():
        return errno.ENOTDIR
    if not is_folder and is_stream(path):
        return None if os.access(path, os.W_OK) else errno.EACCES
    folder = path if is_folder else path.parent
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        return errno.ENOTDIR
    if os.access(folder, os.W_OK | os.X_OK):
        return None
    return errno.EROFS if os.statvfs(folder).f_flag & os.ST_RDONLY else errno.EACCES
