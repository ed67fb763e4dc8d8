"""Names of files and folders in a dataset."""

from __future__ import annotations

from pathlib import Path

RECIPE_FILE = "recipe.toml"
MANIFEST_FILE = "manifest.json"
CARD_FILE = "README.md"
CROISSANT_FILE = "croissant.json"
BLIND_FILE = "blind.json"
EVENTS_FILE = "events.jsonl"
RECORD_FILE = "record.json"
FRAMES_FOLDER = "frames"
SHARDS_FOLDER = "shards"
SHARDS_FILE = "shards/layout.json"
ANNOTATIONS_FOLDER = "annotations"
CALIBRATION_FOLDER = "calibration"
MESHES_FOLDER = "meshes"

_MOST_DIGITS = 12


def frame_folder(dataset: Path, frame_index: int) -> Path:
    """Folder of one frame of a dataset on the local disk."""
    return dataset / frame_name(frame_index)


def frame_name(frame_index: int) -> str:
    """Folder of one frame, relative to its dataset."""
    return f"{FRAMES_FOLDER}/{frame_index:06d}"


def frame_of_name(name: str) -> int | None:
    """Index of the frame, or number of the tar file, that has exactly this name; None for any other name."""
    # Digits of other scripts are decimal too, and 7 is no other name of 000007.
    if not (name.isascii() and name.isdecimal() and len(name) <= _MOST_DIGITS):
        return None
    return int(name) if f"{int(name):06d}" == name else None


def frame_indices(dataset: Path) -> list[int]:
    """Indices of the frames with folders on the local disk, ascending; see `FrameStore` for tar files and URLs."""
    folder = dataset / FRAMES_FOLDER
    if not folder.is_dir():
        return []
    return sorted(
        index
        for entry in folder.iterdir()
        if (index := frame_of_name(entry.name)) is not None and (entry / RECORD_FILE).is_file()
    )


def shard_file(number: int) -> str:
    """Tar file of frames, relative to its dataset."""
    return f"{SHARDS_FOLDER}/{number:06d}.tar"


def shard_index_file(number: int) -> str:
    """Index of that tar file, with offsets and hashes."""
    return f"{SHARDS_FOLDER}/{number:06d}.json"


def is_plain_name(name: str) -> bool:
    """Whether a file name stays in its folder on every system."""
    return name not in ("", ".", "..") and not any(character in name for character in "/\\:\0")


def image_file(eye: str) -> str:
    """Image of an eye."""
    return f"{eye}.png"


def mosaic_file(eye: str) -> str:
    """Raw mosaic of an eye with a Bayer sensor."""
    return f"{eye}_mosaic.png"


def parts_file(eye: str) -> str:
    """Part ids of an eye."""
    return f"{eye}_parts.png"


def passes_file(eye: str) -> str:
    """Linear radiance, depth, normals and ids of an eye."""
    return f"{eye}.exr"
