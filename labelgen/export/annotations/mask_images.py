"""Exports part masks as PNG images, a folder for each pair: every part's visible and amodal mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.part_pixels import parts_mask
from labelgen.segmentation_masks import Mask, amodal_masks, named_parts, union_of_masks


def write_masks(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write `000123/left_rim_visible.png` and `left_rim_amodal.png`, 255 on the part and 0 elsewhere.

    Empty masks have no file. Arguments and errors as in `labelgen.export.formats`.
    """
    source = Dataset(dataset)
    with new_folder(out) as folder:
        for record in log.records(source):
            pair = folder / f"{record.frame_index:06d}"
            pair.mkdir()
            for eye in EYES:
                part_id = source.part_ids(record.frame_index, eye)
                alone = amodal_masks(record, eye, part_id)
                for name, parts in named_parts(record).items():
                    _write(pair / f"{eye}_{name}_visible.png", parts_mask(part_id, parts))
                    _write(pair / f"{eye}_{name}_amodal.png", union_of_masks(alone, parts, part_id.shape))
    return [out]


def _write(path: Path, mask: Mask) -> None:
    if mask.any():
        path.write_bytes(encode_png(mask.astype(np.uint8) * np.uint8(255), is_piecewise_constant=True))
