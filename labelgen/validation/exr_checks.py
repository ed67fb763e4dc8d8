"""Checks a pair's EXR files against part ids and labels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import passes_file
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import Part
from geometry.stereo import Eye
from labelgen.part_pixels import FeaturePixels
from labelgen.validation.label_checks import check_feature_pixels, named_features

# A unit vector in float32, turned by a rotation in float32.
_UNIT_TOLERANCE = 1e-5

Plane = NDArray[np.float32]


def passes_faults(dataset: Dataset, record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> list[str] | None:
    """Faults of the passes of one eye, or None where the pair has none.

    Args:
        dataset: that holds the pair.
        record: of the pair; its hashes must have been checked, as changed files must not reach the decoder.
        eye: which eye.
        part_id: (H, W) part ids of the PNG file.
    """
    name = passes_file(eye)
    if name not in record.file_sha256:
        return None
    try:
        data = dataset.frames.read(record.frame_index, name)
        planes = read_passes(data, name, record.frame.rig.camera)
    except ValueError as error:
        return [str(error)]
    faults = []
    if not np.array_equal(planes["id.X"], part_id.astype(np.float32)):
        count = int(np.count_nonzero(planes["id.X"] != part_id))
        faults.append(f"id.X: {count} pixels differ from the part ids")
    if not all(np.isfinite(planes[channel]).all() and (planes[channel] >= 0).all() for channel in "RGB"):
        faults.append("R, G, B: must be finite and not negative")
    return [
        f"{name}: {fault}"
        for fault in [
            *faults,
            *_surface_faults(planes, part_id),
            *_feature_faults(record, eye, planes["depth.Z"], part_id),
        ]
    ]


def _surface_faults(planes: dict[str, Plane], part_id: NDArray[np.uint8]) -> list[str]:
    """Faults of depth and normals, of surfaces and of the sky."""
    faults = []
    depth, sky = planes["depth.Z"], part_id == Part.SKY
    if not np.isposinf(depth[sky]).all() or not (np.isfinite(depth[~sky]) & (depth[~sky] > 0)).all():
        faults.append("depth.Z: must be infinite for the sky and finite and above 0 elsewhere")
    length = np.sqrt(sum(planes[f"normal.{axis}"].astype(np.float64) ** 2 for axis in "XYZ"))
    if np.abs(length - ~sky).max(initial=0.0) > _UNIT_TOLERANCE:
        faults.append("normal: must be 0 for the sky and of length 1 elsewhere")
    return faults


def _feature_faults(record: PairRecord, eye: Eye, depth_m: Plane, part_id: NDArray[np.uint8]) -> list[str]:
    """Faults of markers and hub against the planes that follow from the pose."""
    pose, drogue = record.left_from_drogue, record.frame.drogue
    if pose is None or drogue is None:
        return []
    layout, pixels = marker_layout(drogue), FeaturePixels(part_id)
    return [
        f"{name}: {fault}"
        for name, _, disc in named_features(record, layout, pose, eye)
        for fault in check_feature_pixels(disc, layout.hub_inner_radius_m if name == "hub" else 0.0, depth_m, pixels)
    ]
