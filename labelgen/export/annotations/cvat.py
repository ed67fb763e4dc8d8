"""Datasets as CVAT reads them: `annotations.xml` in the format "CVAT for images 1.1" and `images/SPLIT`.

Coordinates count from the image's corner. The drogue has a box and a mask; hub and markers have a mask, and a point at
the projection of their centre. Shapes of one object are a group. Masks are run lengths of the rows of their box, the
first of zeros.

Source: CVAT's documentation of its XML format, version 1.1.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from drogue_models.parts import MAX_MARKERS
from labelgen.export.annotations.annotated_views import (
    IMAGES_FOLDER,
    AnnotatedObject,
    AnnotatedView,
    annotated_views,
)
from labelgen.export.annotations.part_masks import MaskPixels
from labelgen.export.export_log import ExportLog

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
            stream.write(_mask(one, one.pixels, group))
        if one.center is not None:
            stream.write(
                f'    <points label="{one.label}" source="file" occluded="0" points="{one.center[0]!r},'
                f'{one.center[1]!r}" z_order="2" group_id="{group}">{_attributes(one)}</points>\n'
            )
    stream.write("  </image>\n")


def _mask(one: AnnotatedObject, pixels: MaskPixels, group: int) -> str:
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
