"""Our corpus as ultralytics reads it: our own export, with the drogue as its only class."""

from __future__ import annotations

from pathlib import Path

from datasets_manifest.atomic import new_folder
from datasets_manifest.reader import Dataset
from labelgen.export.log import ExportLog
from labelgen.export.yolo import write_yolo_detect

_DROGUE_ROW = "0 "


def export_corpus(corpus: Path, out: Path) -> Path:
    """Write images and boxes, unless they are there already.

    Args:
        corpus: a dataset whose images look as a screen wants them.
        out: folder.

    Returns:
        The file `data.yaml`.

    Raises:
        ValueError: the corpus cannot be read, its images are linear or of 12 bits, or it has no pairs to train on.
        OSError: the folder cannot be written; it is then not there.
    """
    source = Dataset(corpus)
    sensor = source.manifest.recipe.sensor
    if (sensor.encoding, sensor.output_bits) != ("gamma", 8):
        raise ValueError(
            f"{corpus}: ultralytics takes images of 8 bits, encoded for a screen (gamma), got "
            f"{sensor.output_bits} bits, {sensor.encoding}; render a recipe with rig.encoding = 'gamma'"
        )
    counts = source.manifest.counts.by_split
    if not counts.get("train") or not counts.get("val"):
        raise ValueError(f"{corpus}: needs pairs in the splits train and val, got {dict(counts)}")
    data = out / "data.yaml"
    if not data.exists():
        with new_folder(out) as folder:
            # The export makes the folder itself, and wants it not to be there.
            exported = folder / "corpus"
            write_yolo_detect(corpus, exported, ExportLog())
            for labels in (exported / "labels").rglob("*.txt"):
                rows = labels.read_text(encoding="utf-8").splitlines(keepends=True)
                labels.write_text("".join(row for row in rows if row.startswith(_DROGUE_ROW)), encoding="utf-8")
            for entry in exported.iterdir():
                entry.rename(folder / entry.name)
            exported.rmdir()
            splits = "".join(f"{name}: images/{name}\n" for name in ("train", "val", "test") if counts.get(name))
            (folder / "data.yaml").write_text(f'path: ""\n{splits}names:\n  0: drogue\n', encoding="utf-8")
    return data


def images_to_train_on(corpus: Path) -> int:
    """How many images an epoch has: both eyes of every pair of the split `train`.

    Raises:
        ValueError: the corpus cannot be read.
    """
    return 2 * Dataset(corpus).manifest.counts.by_split.get("train", 0)
