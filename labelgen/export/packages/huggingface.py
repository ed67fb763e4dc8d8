"""A folder that Hugging Face's `load_dataset` reads and its Hub shows: a card, and Parquet files with a row a pair.

Images are within the rows. The card names the columns, so that readers need not look into the files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from datasets_manifest.atomic import new_folder
from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.release.card import card_metadata, card_sections, card_summary
from datasets_manifest.storage.layout import CALIBRATION_FOLDER, CARD_FILE, MANIFEST_FILE, RECIPE_FILE
from datasets_manifest.storage.manifest import Manifest, SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP, Part, part_name
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import DISPLAY_REMARK
from labelgen.export.packages.huggingface_columns import HubColumn, arrow_type, hub_columns, hub_row, yaml_feature

SHARD_BYTES = 500_000_000
"""A file ends before it would grow beyond this, unless one row is larger; what `datasets` aims at too."""

# The Hub's viewer reads whole groups of rows.
_GROUP_BYTES = 50_000_000

_TABLES_FOLDER = "data"

SPLIT_NAMES: dict[SplitName, str] = {"train": "train", "val": "validation", "test": "test"}
"""Hugging Face's names of the splits, in the card's order."""


def write_huggingface(dataset: Location, out: Path, log: ExportLog, shard_bytes: int = SHARD_BYTES) -> list[Path]:
    """Write `README.md` and `data/SPLIT-NNNNN-of-NNNNN.parquet`, with manifest, recipe and calibration beside them.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts the labels that are cut off or missing.
        shard_bytes: the largest size of a file. [B]

    Returns:
        The folder.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source, storage = Dataset(dataset), open_storage(dataset)
    manifest = source.manifest
    split_of_frame = manifest.split_of_frame()
    columns = hub_columns(manifest)
    present = [split for split in SPLIT_NAMES if split in split_of_frame.values()]
    with new_folder(out) as folder:
        tables = folder / _TABLES_FOLDER
        tables.mkdir()
        with ExitStack() as stack:
            writers = {
                split: stack.enter_context(_split_table(tables, SPLIT_NAMES[split], _schema(columns), shard_bytes))
                for split in present
            }
            for record in log.records(source):
                split = split_of_frame[record.frame_index]
                writers[split].add(hub_row(source, record, split, log))
        # Of a split all of whose pairs are damaged there is no file.
        sizes = [size for split in present if (size := writers[split].size()).rows]
        (folder / CARD_FILE).write_text(hub_card(manifest, columns, sizes), encoding="utf-8", newline="\n")
        for name in (MANIFEST_FILE, RECIPE_FILE):
            if storage.exists(name):
                (folder / name).write_bytes(storage.read(name))
        (folder / CALIBRATION_FOLDER).mkdir()
        for name, text in calibration_files(manifest.recipe.rig).items():
            (folder / CALIBRATION_FOLDER / name).write_text(text, encoding="utf-8", newline="\n")
    bits, is_linear = manifest.recipe.sensor.output_bits, manifest.recipe.sensor.encoding == "linear"
    if is_linear:
        log.remark(DISPLAY_REMARK)
    elif bits > 8:
        log.remarks.append(f"of {bits}-bit images all bits are in the files, moved to the top of 16")
    if bits > 8 and manifest.recipe.sensor.color != "mono":
        log.remarks.append("Pillow, which `datasets` uses, reads the upper 8 bits of colour images; the card says more")
    return [out]


def _schema(columns: dict[str, HubColumn]) -> pa.Schema:
    features = {name: column.feature for name, column in columns.items()}
    about = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.schema({name: arrow_type(feature) for name, feature in features.items()}, metadata=about)


@dataclass(frozen=True)
class SplitSize:
    """How much a split has, for the card: rows, bytes in memory, and bytes of its files."""

    name: str
    rows: int
    memory_bytes: int
    file_bytes: int


class _SplitTable:
    """The files of one split, one of them open; named by their number until it is known how many there are."""

    def __init__(self, folder: Path, name: str, schema: pa.Schema, shard_bytes: int) -> None:
        self._folder, self._name, self._schema, self._limit = folder, name, schema, shard_bytes
        self._group: list[dict[str, Any]] = []
        self._group_bytes = self._shard_bytes = 0
        self._writer: pq.ParquetWriter | None = None
        self._paths: list[Path] = []
        self._rows = self._memory_bytes = self._file_bytes = 0

    def add(self, row: dict[str, Any]) -> None:
        """Append a pair."""
        size = _row_bytes(row)
        if self._shard_bytes and self._shard_bytes + size > self._limit:
            self.close()
        elif self._group_bytes and self._group_bytes + size > _GROUP_BYTES:
            self._flush()
        self._group.append(row)
        self._group_bytes += size
        self._shard_bytes += size
        self._rows += 1

    def close(self) -> None:
        """End the open file."""
        self._flush()
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()
            self._file_bytes += self._paths[-1].stat().st_size
        self._shard_bytes = 0

    def discard(self) -> None:
        """Let go of the open file, which is incomplete."""
        self._group = []
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()

    def finish(self) -> None:
        """End the last file, and name all by how many there are."""
        self.close()
        for number, path in enumerate(self._paths):
            path.rename(self._folder / f"{self._name}-{number:05d}-of-{len(self._paths):05d}.parquet")

    def size(self) -> SplitSize:
        """Of all files."""
        return SplitSize(self._name, self._rows, self._memory_bytes, self._file_bytes)

    def _flush(self) -> None:
        if not self._group:
            return
        if self._writer is None:
            self._paths.append(self._folder / f"{self._name}-{len(self._paths):05d}.parquet")
            # Nearly all of a row are images, which hold no repeats; the page index lets the Hub fetch single rows.
            self._writer = pq.ParquetWriter(
                self._paths[-1], self._schema, compression="zstd", use_dictionary=False, write_page_index=True
            )
        table = pa.Table.from_pylist(self._group, schema=self._schema)
        self._writer.write_table(table, row_group_size=len(self._group))
        self._memory_bytes += table.nbytes
        self._group, self._group_bytes = [], 0


@contextmanager
def _split_table(folder: Path, name: str, schema: pa.Schema, shard_bytes: int) -> Iterator[_SplitTable]:
    """The files of a split, which are complete when the block ends without an error."""
    table = _SplitTable(folder, name, schema, shard_bytes)
    try:
        yield table
        table.finish()
    finally:
        table.discard()


def _row_bytes(value: Any) -> int:
    """About the size of a row in a file: of its images and texts. [B]"""
    if isinstance(value, dict):
        return sum(map(_row_bytes, value.values()))
    return len(value) if isinstance(value, bytes | str) else 8


_CARD = """\
{summary}
* A row is a pair. Beside the table, `manifest.json` holds axes, units and conventions, `recipe.toml` the recipe, and
  `calibration/` the rig for OpenCV, Kalibr and ROS.

```python
from datasets import load_dataset

pairs = load_dataset("{name}", split="{split}")  # the folder, or OWNER/NAME on the Hub
```

| column | what it is |
|---|---|
{columns}

* Points and boxes count from the image's corner: the centre of the top-left pixel is (0.5, 0.5). Camera matrices take
  it at (0, 0), as OpenCV does: subtract 0.5 from a point before you compare it with a projection.
* Cameras look along z, with x to the right and y down. `a_from_b` takes coordinates in b to coordinates in a, and a
  point goes to camera by `camera_from_left` after `left_from_drogue`. Quaternions are x, y, z, w.
* A keypoint's `id` is the number of the marker on the drogue; `visibility` is COCO's: 0 outside the image (then
  `point` is 0, 0), 1 less than half visible, 2 visible. A drogue of which no pixel is seen has no `objects`.
* Part ids: {parts}.
{notes}"""


def hub_card(manifest: Manifest, columns: dict[str, HubColumn], sizes: list[SplitSize]) -> str:
    """The card: front matter with types, splits and files, then what the columns hold."""
    front = {
        **card_metadata(manifest),
        "configs": [
            {
                "config_name": "default",
                "data_files": [
                    {"split": size.name, "path": f"{_TABLES_FOLDER}/{size.name}-*.parquet"} for size in sizes
                ],
            }
        ],
        "dataset_info": {
            "features": [{"name": name, **yaml_feature(column.feature)} for name, column in columns.items()],
            "splits": [
                {"name": size.name, "num_bytes": size.memory_bytes, "num_examples": size.rows} for size in sizes
            ],
            "download_size": sum(size.file_bytes for size in sizes),
            "dataset_size": sum(size.memory_bytes for size in sizes),
        },
    }
    text = _CARD.format(
        summary=card_summary(manifest),
        name=manifest.name,
        split=sizes[0].name,
        columns="\n".join(f"| `{name}` | {column.meaning} |" for name, column in columns.items()),
        parts=_parts_line(),
        notes="".join(f"* {note}\n" for note in _notes(manifest)),
    )
    return f"---\n{yaml.safe_dump(front, sort_keys=False)}---\n\n{text}\n{card_sections(manifest)}"


def _parts_line() -> str:
    named = ", ".join(f"{int(part)} {part_name(part)}" for part in Part)
    return (
        f"{named}, and {FIRST_MARKER_ID} + i marker i. Those of a second drogue and its hose are {INSTANCE_STEP} "
        f"higher, those of a third {2 * INSTANCE_STEP}"
    )


def _notes(manifest: Manifest) -> list[str]:
    """What only some datasets need said."""
    sensor, notes = manifest.recipe.sensor, []
    if manifest.recipe.outputs.exr:
        notes.append(
            'Depth is a column of bytes: `pairs.cast_column("left_depth_m", datasets.Image())` decodes it to metres.'
        )
    if sensor.encoding == "linear":
        samples = 8 if sensor.output_bits == 8 else 16
        notes.append(
            f"The sensor is linear. Images are encoded for screens, in {samples} bits: sRGB (IEC 61966-2-1), 0 at the "
            "black level."
        )
    kept = [] if sensor.encoding == "linear" else ["Images"]
    kept += ["Mosaics"] if sensor.color == "bayer" else []
    if sensor.output_bits > 8 and kept:
        low = 16 - sensor.output_bits
        notes.append(
            f"{' and '.join(kept).capitalize()} have {sensor.output_bits} bits at the top of 16: shift values right by "
            f"{low} to get them."
        )
    if sensor.output_bits > 8 and sensor.color != "mono":
        notes.append(
            "`datasets` decodes images with Pillow, which keeps 8 bits of colour images. To get all, take the file:\n"
            '  `pairs.cast_column("left_image", datasets.Image(decode=False))`, and then\n'
            '  `cv2.imdecode(np.frombuffer(row["left_image"]["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)`.'
        )
    return notes
