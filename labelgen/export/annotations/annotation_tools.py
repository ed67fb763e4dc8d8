"""Datasets as annotation tools read them: CVAT, Label Studio and FiftyOne, each with its images.

* CVAT: `annotations.xml` in the format "CVAT for images 1.1" and `images/SPLIT`. Coordinates count from the image's
  corner. The drogue has a box and a mask; hub and markers have a mask, and a point at the projection of their centre.
  Shapes of one object are a group. Masks are run lengths of the rows of their box, the first of zeros. Source: CVAT's
  documentation of its XML format, version 1.1.
* Label Studio: `tasks.json`, its `label_config.xml`, and `images/SPLIT`. Every view is a task with one annotation: a
  rectangle around the drogue, polygons of the drogue, its hub and its markers, and a keypoint for each marker on the
  image. Lengths are per cent of the image's width and height, counted from its corner. Polygons go along the edges of
  pixels; where that takes many corners, they are thinned out by at most half a pixel, because the editor becomes slow.
  Polygons of Label Studio have no holes. Source: its documentation of its JSON format and of its tags for images.
* FiftyOne: groups of a left and a right image with detections and keypoints. `metadata.json` and `samples.json` are
  its own serialization without a version, of which its importer `FiftyOneDataset` infers the fields. Lengths are shares
  of the image's width and height, counted from its corner. Masks are compressed arrays of the boxes' pixels. Source:
  its documentation of `FiftyOneDataset`, grouped datasets and instance masks.
"""

from __future__ import annotations

import base64
import io
import zlib
from pathlib import Path
from typing import IO, Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import shapely

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from drogue_models.parts import MAX_MARKERS
from labelgen.export.annotations.annotated_views import (
    IMAGES_FOLDER,
    AnnotatedObject,
    AnnotatedView,
    annotated_views,
)
from labelgen.export.annotations.part_masks import MaskPixels
from labelgen.export.export_log import ExportLog
from labelgen.export.keypoints import keypoint_count

ANNOTATIONS_FILE = "annotations.xml"

# Groups within an image: 1 the drogue, 2 its hub, then the markers.
_DROGUE_GROUP, _HUB_GROUP, _FIRST_MARKER_GROUP = 1, 2, 3
# Drogues beside the sought one come after the groups of as many markers as a drogue can have.
_LAST_MARKER_GROUP = _FIRST_MARKER_GROUP + MAX_MARKERS

_LABELS = (("drogue", "#ff5c00", ""), ("marker", "#00c8ff", "index"), ("hub", "#c800ff", ""))


def write_cvat(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write annotations and images; the folder, zipped, is what CVAT takes as "CVAT 1.1".

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
    with new_folder(out) as folder, (folder / ANNOTATIONS_FILE).open("w", encoding="utf-8", newline="\n") as stream:
        stream.write('<?xml version="1.0" encoding="utf-8"?>\n<annotations>\n  <version>1.1</version>\n')
        stream.write(_meta(source.manifest))
        for number, view in enumerate(annotated_views(source, folder / IMAGES_FOLDER, log)):
            _write_view(stream, number, view)
        stream.write("</annotations>\n")
    return [out]


def _meta(manifest: Manifest) -> str:
    """The task's name and labels."""
    labels = ""
    for name, color, attribute in _LABELS:
        described = (
            f"<attribute><name>{attribute}</name><mutable>False</mutable><input_type>number</input_type>"
            "<default_value>0</default_value><values>0\n255\n1</values></attribute>"
            if attribute
            else ""
        )
        labels += (
            f"        <label><name>{name}</name><color>{color}</color><type>any</type>"
            f"<attributes>{described}</attributes></label>\n"
        )
    return (
        "  <meta>\n    <task>\n"
        f"      <name>{escape(manifest.name)}</name>\n      <size>{2 * len(manifest.frames)}</size>\n"
        "      <mode>annotation</mode>\n"
        f"      <labels>\n{labels}      </labels>\n"
        "    </task>\n  </meta>\n"
    )


def _write_view(stream: IO[str], number: int, view: AnnotatedView) -> None:
    width, height = view.size_px
    stream.write(f'  <image id="{number}" name={quoteattr(view.file_name)} width="{width}" height="{height}">\n')
    for one in view.objects:
        group = _group(one)
        if one.label == "drogue":
            x, y, box_width, box_height = one.box
            stream.write(
                f'    <box label="drogue" source="file" occluded="0" xtl="{x!r}" ytl="{y!r}" xbr="{x + box_width!r}" '
                f'ybr="{y + box_height!r}" z_order="0" group_id="{group}"></box>\n'
            )
        if one.pixels is not None:
            stream.write(_cvat_mask(one, one.pixels, group))
        if one.center is not None:
            stream.write(
                f'    <points label="{one.label}" source="file" occluded="0" points="{one.center[0]!r},'
                f'{one.center[1]!r}" z_order="2" group_id="{group}">{_attributes(one)}</points>\n'
            )
    stream.write("  </image>\n")


def _cvat_mask(one: AnnotatedObject, pixels: MaskPixels, group: int) -> str:
    left, top, inside = pixels.crop()
    height, width = inside.shape
    flat = inside.ravel()
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    if flat[0]:
        runs.insert(0, 0)
    return (
        f'    <mask label="{one.label}" source="file" occluded="0" rle="{", ".join(map(str, runs))}" left="{left}" '
        f'top="{top}" width="{width}" height="{height}" z_order="{int(one.label != "drogue")}" group_id="{group}">'
        f"{_attributes(one)}</mask>\n"
    )


def _attributes(one: AnnotatedObject) -> str:
    return "" if one.marker_index is None else f'<attribute name="index">{one.marker_index}</attribute>'


def _group(one: AnnotatedObject) -> int:
    if one.instance:
        return _LAST_MARKER_GROUP + one.instance
    if one.marker_index is not None:
        return _FIRST_MARKER_GROUP + one.marker_index
    return _DROGUE_GROUP if one.label == "drogue" else _HUB_GROUP


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


DATA_FOLDER = "data"


def write_fiftyone(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write images and samples.

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
    manifest = source.manifest
    about = {
        "media_type": "group",
        "info": {
            "name": manifest.name,
            "dataset_sha256": manifest.dataset_sha256,
            "licence": manifest.data_licence,
            "transforms": manifest.conventions["transforms"],
        },
    }
    with new_folder(out) as folder:
        (folder / "metadata.json").write_text(canonical_json(about) + "\n", encoding="utf-8", newline="\n")
        with (folder / "samples.json").open("w", encoding="utf-8", newline="\n") as stream:
            stream.write('{"samples":[')
            for number, view in enumerate(annotated_views(source, folder / DATA_FOLDER, log)):
                stream.write((",\n" if number else "\n") + canonical_json(_sample(view)))
            stream.write("\n]}\n")
    return [out]


def _sample(view: AnnotatedView) -> dict[str, Any]:
    record = view.record
    pose = record.left_from_drogue
    return {
        "filepath": f"{DATA_FOLDER}/{view.file_name}",
        "tags": [view.split],
        "_media_type": "image",
        "group": {"_cls": "Group", "_id": {"$oid": f"{record.frame_index:024x}"}, "name": view.eye},
        "frame_index": record.frame_index,
        "scene_id": record.scene_id,
        "time_s": record.time_s,
        "left_from_drogue": None if pose is None else pose.as_matrix().tolist(),
        "objects": {"_cls": "Detections", "detections": [_detection(view, one) for one in view.objects]},
        "keypoints": {"_cls": "Keypoints", "keypoints": [_keypoints(view)] if view.keypoints else []},
    }


def _detection(view: AnnotatedView, one: AnnotatedObject) -> dict[str, Any]:
    (width, height), (x, y, box_width, box_height) = view.size_px, one.box
    return {
        "_cls": "Detection",
        "label": one.label,
        "bounding_box": [x / width, y / height, box_width / width, box_height / height],
        "marker_index": one.marker_index,
        "visible_fraction": one.visible_fraction,
        **({"sought": one.instance == 0} if view.record.frame.neighbours else {}),
        "tags": [],
        "mask": None if one.pixels is None else {"$binary": {"base64": _fiftyone_mask(one.pixels), "subType": "00"}},
    }


def _fiftyone_mask(pixels: MaskPixels) -> str:
    """The array of a mask within its box, as FiftyOne serializes arrays."""
    stream = io.BytesIO()
    np.save(stream, pixels.crop()[2], allow_pickle=False)
    return base64.b64encode(zlib.compress(stream.getvalue())).decode("ascii")


def _keypoints(view: AnnotatedView) -> dict[str, Any]:
    """The markers on the image; lists beside the points say which they are and whether they are hidden."""
    width, height = view.size_px
    shown = [(index, point) for index, point in enumerate(view.keypoints) if point.flag]
    return {
        "_cls": "Keypoint",
        "label": "drogue",
        "points": [[point.x / width, point.y / height] for _, point in shown],
        "marker_index": [index for index, _ in shown],
        "flag": [point.flag for _, point in shown],
        "tags": [],
    }
