"""Exports a dataset without its truth, for challenges: all that the blind reader gives to navigation.

It contains neither the recipe nor its seed, which would reproduce the truth, nor scenes, splits, conditions, part ids
or the hashes of the records. Frame indices stay, so that the owner of the dataset can score estimates.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datasets_manifest.atomic import new_folder
from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.storage.blind import read_blind_index
from datasets_manifest.storage.layout import (
    BLIND_FILE,
    CALIBRATION_FOLDER,
    RECORD_FILE,
    frame_folder,
    image_file,
    mosaic_file,
)
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import export_file


def write_blind(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write images, time stamps, rig, drogue and calibration.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: receives the progress.

    Returns:
        The folder.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source = Dataset(dataset)
    index = read_blind_index(dataset)
    mosaics = [mosaic_file(eye) for eye in EYES if index.sensor.color == "bayer"]
    names = [*(image_file(eye) for eye in EYES), *mosaics]
    with new_folder(out) as folder:
        for name, text in calibration_files(index.rig).items():
            _write_text(folder / CALIBRATION_FOLDER / name, text)
        for record in log.records(source):
            target = frame_folder(folder, record.frame_index)
            for name in names:
                export_file(source, record.frame_index, name, target / name)
            _write_text(target / RECORD_FILE, canonical_json(_blind_record(record, index.drogues_differ)) + "\n")
        _write_text(folder / BLIND_FILE, canonical_json(index.model_dump(mode="json")) + "\n")
    return [out]


def _blind_record(record: PairRecord, drogues_differ: bool) -> dict[str, Any]:
    """Time stamp, exposure and black level under the keys of a record, and the drogue where drogues differ."""
    frame = record.frame
    sought = frame.drogue or frame.sought
    named = {"sought": sought.model_dump(mode="json")} if drogues_differ and sought is not None else {}
    return {
        "time_s": record.time_s,
        "image_black_level_dn": record.image_black_level_dn,
        "frame": {"exposure": {"time_s": frame.exposure.time_s}, **named},
    }


def _write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", newline="\n")
