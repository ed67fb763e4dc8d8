"""Where things lie in a dataset folder."""

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


def frame_folder(dataset: Path, frame_index: int) -> Path:
    """Folder of one frame of a dataset on this machine's disk."""
    return dataset / frame_name(frame_index)


def frame_name(frame_index: int) -> str:
    """Folder of one frame below its dataset."""
    return f"{FRAMES_FOLDER}/{frame_index:06d}"


def frame_indices(dataset: Path) -> list[int]:
    """Indices of the frames that have folders on this machine's disk, ascending; `FrameStore` knows all others too."""
    folder = dataset / FRAMES_FOLDER
    if not folder.is_dir():
        return []
    return sorted(
        int(entry.name) for entry in folder.iterdir() if entry.name.isdecimal() and (entry / RECORD_FILE).is_file()
    )


def shard_file(number: int) -> str:
    """A tar file of frames."""
    return f"{SHARDS_FOLDER}/{number:06d}.tar"


def shard_index_file(number: int) -> str:
    """What lies where in that tar file, with hashes."""
    return f"{SHARDS_FOLDER}/{number:06d}.json"


def is_plain_name(name: str) -> bool:
    """Whether a file name stays in its folder on every system."""
    return name not in ("", ".", "..") and not any(character in name for character in "/\\:\0")


def image_file(eye: str) -> str:
    """What the camera saw."""
    return f"{eye}.png"


def mosaic_file(eye: str) -> str:
    """The raw mosaic of a Bayer sensor."""
    return f"{eye}_mosaic.png"


def parts_file(eye: str) -> str:
    """Part ids."""
    return f"{eye}_parts.png"


def passes_file(eye: str) -> str:
    """Linear radiance, depth, normals and ids."""
    return f"{eye}.exr"
