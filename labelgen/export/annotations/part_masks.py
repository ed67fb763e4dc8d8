"""Masks of the drogue and its features from part ids, and their export as PNG images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import FeatureView, PixelBox, ViewRecord
from drogue_models.parts import Part, marker_id
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.part_pixels import FeaturePixels, drogue_mask, parts_mask
from labelgen.segmentation_masks import Mask, amodal_masks, named_parts, union_of_masks

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MaskPixels:
    """The pixels of one mask, column by column as in COCO.

    Attributes:
        columns, rows: (N,) of each pixel. [px]
        size_px: (width, height) of the image. [px]
    """

    columns: Indices
    rows: Indices
    size_px: tuple[int, int]

    def segmentation(self) -> dict[str, Any]:
        """COCO's compressed run lengths, the first of them outside the set.

        Source: the mask format of the COCO API (runs of the column-major image, beginning with zeros).
        """
        width, height = self.size_px
        flat = self.columns * height + self.rows
        breaks = np.flatnonzero(np.diff(flat) != 1)
        starts, ends = flat[np.r_[0, breaks + 1]], flat[np.r_[breaks, len(flat) - 1]] + 1
        edges = np.stack([starts, ends], axis=1).ravel()
        counts = np.diff(np.concatenate([[0], edges, [width * height]]))
        runs = counts[:-1] if counts[-1] == 0 else counts
        packed = coco_mask.frPyObjects({"size": [height, width], "counts": runs.tolist()}, height, width)
        return {"size": [height, width], "counts": packed["counts"].decode("ascii")}

    def corner_box(self) -> list[float]:
        """x, y, width and height of the box around the pixels' areas, counted from the image's corner. [px]"""
        low_u, low_v = int(self.columns.min()), int(self.rows.min())
        return [
            float(low_u),
            float(low_v),
            float(int(self.columns.max()) - low_u + 1),
            float(int(self.rows.max()) - low_v + 1),
        ]

    def crop(self) -> tuple[int, int, NDArray[np.bool_]]:
        """First column and row of the box around the pixels, and (h, w) which pixels of the box they are."""
        u, v, width, height = map(round, self.corner_box())
        inside = np.zeros((height, width), dtype=np.bool_)
        inside[self.rows - v, self.columns - u] = True
        return u, v, inside

    def __len__(self) -> int:
        return len(self.columns)


@dataclass(frozen=True, eq=False)
class SeenFeature:
    """A marker, or the hub, of which a pixel is seen.

    Attributes:
        marker_index: of the marker, None for the hub.
        feature: its labels.
        pixels: those that see it.
    """

    marker_index: int | None
    feature: FeatureView
    pixels: MaskPixels


class DroguePixels:
    """Masks of the drogue and its features in one eye's image, computed within the drogue's visible box."""

    def __init__(self, part_id: NDArray[np.uint8], box: PixelBox, marker_count: int, instance: int = 0) -> None:
        """Crop the part ids.

        Args:
            part_id: (H, W) of the whole image.
            box: `box_visible_xywh_px` of the view.
            marker_count: of the drogue.
            instance: which drogue, see `drogue_part_ids`; features are those of the sought one, 0.
        """
        u, v = round(box[0] + 0.5), round(box[1] + 0.5)
        crop = part_id[v : v + round(box[3]), u : u + round(box[2])]
        # Transposed, rows come in the order of the image's columns, which is COCO's.
        self._turned = np.ascontiguousarray(crop.T)
        self._low = u, v
        self._size_px = part_id.shape[1], part_id.shape[0]
        self._marker_count, self._instance = marker_count, instance
        self._features = FeaturePixels(self._turned)

    def drogue(self) -> MaskPixels:
        """The whole drogue."""
        return self._set(*np.nonzero(drogue_mask(self._turned, self._marker_count, self._instance)))

    def features(self, view: ViewRecord) -> list[SeenFeature]:
        """Hub and markers of which a pixel is seen."""
        labels: list[tuple[int | None, FeatureView]] = [] if view.hub is None else [(None, view.hub)]
        labels += list(enumerate(view.markers))
        seen = []
        for index, feature in labels:
            pixels = self._set(*self._features.indices(int(Part.HUB) if index is None else marker_id(index)))
            if len(pixels):
                seen.append(SeenFeature(index, feature, pixels))
        return seen

    def _set(self, columns: Indices, rows: Indices) -> MaskPixels:
        return MaskPixels(columns + self._low[0], rows + self._low[1], self._size_px)


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
