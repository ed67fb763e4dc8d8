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
ANNOTATIONS_FOLDER = "annotations"
CALIBRATION_FOLDER = "calibration"


def frame_folder(dataset: Path, frame_index: int) -> Path:
    """Folder of one frame."""
    return dataset / FRAMES_FOLDER / f"{frame_index:06d}"


def frame_indices(dataset: Path) -> list[int]:
    """Indices of the frames that are there, ascending."""
    folder = dataset / FRAMES_FOLDER
    if not folder.is_dir():
        return []
    return sorted(
        int(entry.name) for entry in folder.iterdir() if entry.name.isdecimal() and (entry / RECORD_FILE).is_file()
    )


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
