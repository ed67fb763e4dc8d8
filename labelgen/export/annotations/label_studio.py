"""Datasets as Label Studio reads them: `tasks.json`, its `label_config.xml`, and `images/SPLIT`.

Every view is a task with one annotation: a rectangle around the drogue, polygons of the drogue, its hub and its
markers, and a keypoint for each marker on the image. Lengths are per cent of the image's width and height, counted from
its corner. Polygons go along the edges of pixels; where that takes many corners, they are thinned out by at most half a
pixel, because the editor becomes slow. Polygons of Label Studio have no holes.

Source: Label Studio's documentation of its JSON format and of its tags for images.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from labelgen.export.annotations.annotated_views import IMAGES_FOLDER, AnnotatedView, annotated_views
from labelgen.export.annotations.part_masks import MaskPixels
from labelgen.export.export_log import ExportLog
from labelgen.export.keypoints import keypoint_count

TASKS_FILE, CONFIG_FILE = "tasks.json", "label_config.xml"

# The folder that Label Studio serves is this export's; see its settings for local files.
_LOCAL_FILES = "/data/local-files/?d="

_MANY_CORNERS = 100
_THINNED_BY_PX = 0.5


def write_label_studio(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write tasks, configuration and images.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts what the format cannot hold.

    Returns:
        The folder.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source = Dataset(dataset)
    with new_folder(out) as folder:
        (folder / CONFIG_FILE).write_text(_config(keypoint_count(source.manifest)), encoding="utf-8", newline="\n")
        with (folder / TASKS_FILE).open("w", encoding="utf-8", newline="\n") as stream:
            stream.write("[")
            for number, view in enumerate(annotated_views(source, folder / IMAGES_FOLDER, log)):
                stream.write((",\n" if number else "\n") + canonical_json(_task(number + 1, view, log)))
            stream.write("\n]\n")
    return [out]


def _config(count: int) -> str:
    """The labelling interface of the project."""
    objects = "".join(f'    <Label value="{name}"/>\n' for name in ("drogue", "marker", "hub"))
    # Label Studio's converters take the order of keypoints from `model_index`.
    points = "".join(f'    <Label value="marker_{index}" model_index="{index}"/>\n' for index in range(count))
    return (
        '<View>\n  <Image name="image" value="$image"/>\n'
        f'  <RectangleLabels name="box" toName="image">\n    <Label value="drogue"/>\n  </RectangleLabels>\n'
        f'  <PolygonLabels name="mask" toName="image">\n{objects}  </PolygonLabels>\n'
        f'  <KeyPointLabels name="keypoint" toName="image">\n{points}  </KeyPointLabels>\n</View>\n'
    )


def _task(number: int, view: AnnotatedView, log: ExportLog) -> dict[str, Any]:
    record = view.record
    results: list[dict[str, Any]] = []
    for one in view.objects:
        name = one.label if one.marker_index is None else f"marker_{one.marker_index}"
        name = f"neighbour_{one.instance}" if one.instance else name
        if one.label == "drogue":
            x, y, width, height = one.box
            (corner, size) = _per_cent(view, [(x, y), (width, height)])
            value: dict[str, Any] = {"x": corner[0], "y": corner[1], "width": size[0], "height": size[1], "rotation": 0}
            results.append(
                _result(view, f"{name}_box", "box", "rectanglelabels", {**value, "rectanglelabels": ["drogue"]})
            )
        if one.pixels is not None:
            for piece, corners in enumerate(polygons(one.pixels, log)):
                value = {"points": _per_cent(view, corners), "closed": True, "polygonlabels": [one.label]}
                results.append(_result(view, f"{name}_mask_{piece}", "mask", "polygonlabels", value))
    for index, point in enumerate(view.keypoints):
        if point.flag:
            ((x, y),) = _per_cent(view, [(point.x, point.y)])
            value = {"x": x, "y": y, "width": 0.5, "keypointlabels": [f"marker_{index}"]}
            results.append(_result(view, f"keypoint_{index}", "keypoint", "keypointlabels", value))
    return {
        "id": number,
        "data": {
            "image": f"{_LOCAL_FILES}{IMAGES_FOLDER}/{view.file_name}",
            "frame_index": record.frame_index,
            "view": view.eye,
            "split": view.split,
        },
        "annotations": [{"id": number, "result": results}],
    }


def _result(view: AnnotatedView, id_: str, tag: str, kind: str, value: dict[str, Any]) -> dict[str, Any]:
    return {
        "id": f"{view.record.frame_index:06d}_{view.eye}_{id_}",
        "from_name": tag,
        "to_name": "image",
        "type": kind,
        "original_width": view.size_px[0],
        "original_height": view.size_px[1],
        "image_rotation": 0,
        "value": value,
    }


def _per_cent(view: AnnotatedView, points: list[tuple[float, float]]) -> list[list[float]]:
    width, height = view.size_px
    return [[100 * x / width, 100 * y / height] for x, y in points]


def polygons(pixels: MaskPixels, log: ExportLog) -> list[list[tuple[float, float]]]:
    """Corners of the outlines of a mask's pieces, from the image's corner. [px]

    Args:
        pixels: the mask.
        log: counts holes, which outlines do not have, and outlines that are thinned out.
    """
    left, top, inside = pixels.crop()
    # Runs of the rows, as rectangles: their union has exactly the mask's area.
    padded = np.pad(inside, ((0, 0), (1, 1))).astype(np.int8)
    rows, columns = np.nonzero(np.diff(padded, axis=1))
    starts, ends = columns[::2] + left, columns[1::2] + left
    area = shapely.union_all(shapely.box(starts, rows[::2] + top, ends, rows[::2] + top + 1))
    outlines = []
    for piece in sorted(shapely.get_parts(area), key=lambda piece: piece.bounds):
        log.lost("holes in masks, which polygons of Label Studio fill", len(piece.interiors))
        # Without corners on straight edges.
        outline = shapely.Polygon(piece.exterior).simplify(0).normalize()
        if shapely.get_num_coordinates(outline) > _MANY_CORNERS:
            log.lost("outlines of many corners: thinned out by at most half a pixel")
            outline = outline.simplify(_THINNED_BY_PX)
        outlines.append([(float(x), float(y)) for x, y in outline.exterior.coords[:-1]])
    return outlines
