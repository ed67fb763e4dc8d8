"""Disparity and optical flow of every pixel, and what is hidden, in the files that stereo and flow networks read.

Sources: D. Scharstein et al., "High-resolution stereo datasets with subpixel-accurate ground truth", GCPR 2014,
doi:10.1007/978-3-319-11752-2_3 (Middlebury: `calib.txt`, PFM, masks); D. Butler et al., "A naturalistic open source
movie for optical flow evaluation", ECCV 2012, doi:10.1007/978-3-642-33783-3_44 (MPI Sintel: folders and masks);
S. Baker et al., "A database and evaluation methodology for optical flow", IJCV 2011, doi:10.1007/s11263-010-0390-2
(`.flo`: unknown flow is above 1e9).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.image_codecs import encode_png, read_passes
from datasets_manifest.storage.layout import passes_file
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PairRecord
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.dense_matches import PixelMatches, SurfacePasses, flow_matches, stereo_matches
from labelgen.export.export_log import ExportLog, sequence_name
from labelgen.export.frame_files import export_image

UNKNOWN_FLOW_PX = 1e10
_SPLIT_FOLDERS = {"train": "training", "val": "validation", "test": "test"}
_BACKGROUND = "pixels of ground, cloud and others whose motion the dataset does not determine: flow unknown"


def write_middlebury(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write `SPLIT/000123/{im0,im1}.png`, `{disp0,disp1}.pfm`, `{mask0nocc,mask1nocc}.png` and `calib.txt`.

    Arguments and errors as in `labelgen.export.formats`.
    """
    source = Dataset(dataset)
    rig, splits = source.manifest.recipe.rig, source.manifest.split_of_frame()
    if rig.lenses is not None:
        raise ValueError(
            f"{dataset}: has images of real lenses, in which a point's disparity is not along a row; render the recipe "
            "with a rig without lenses"
        )
    _require_depth(dataset, source)
    with new_folder(out) as folder:
        for record in log.records(source):
            index = record.frame_index
            scene = folder / _SPLIT_FOLDERS[splits[index]] / f"{index:06d}"
            scene.mkdir(parents=True)
            passes = _passes(source, record)
            largest_px = 0.0
            for number, eye in enumerate(EYES):
                export_image(source, index, eye, scene / f"im{number}.png", log)
                found = stereo_matches(rig, eye, passes[eye], passes["right" if eye == "left" else "left"])
                disparity_px = found.displacement_px[..., 0] * (-1.0 if eye == "left" else 1.0)
                largest_px = max(largest_px, float(disparity_px.max()))
                (scene / f"disp{number}.pfm").write_bytes(encode_pfm(disparity_px))
                mask = np.where(found.matched, 255, 128).astype(np.uint8)
                (scene / f"mask{number}nocc.png").write_bytes(encode_png(mask, is_piecewise_constant=True))
            (scene / "calib.txt").write_text(_calibration(rig, largest_px), encoding="utf-8")
    return [out]


def write_sintel(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write `SPLIT/{final,flow,occlusions,outofframe,invalid}/SEQUENCE_EYE/frame_0001.*`, both eyes of each sequence.

    A sequence in which pairs are missing goes on in a folder of its own, as readers take neighbours by name.
    Arguments and errors as in `labelgen.export.formats`; also ValueError for a dataset without sequences.
    """
    source = Dataset(dataset)
    if source.manifest.recipe.sequence is None:
        raise ValueError(f"{dataset}: has single pairs, which nothing moves between; flow needs a recipe of [sequence]")
    _require_depth(dataset, source)
    splits = source.manifest.split_of_frame()
    with new_folder(out) as folder:
        last: tuple[PairRecord, Mapping[Eye, SurfacePasses]] | None = None
        place, part = 0, 1
        for record in log.records(source):
            passes = _passes(source, record)
            goes_on = last is not None and last[0].sequence_id == record.sequence_id
            follows = last is not None and goes_on and last[0].frame_index + 1 == record.frame_index
            part = 1 if not goes_on else part + int(not follows)
            place = place + 1 if follows else 1
            root = folder / _SPLIT_FOLDERS[splits[record.frame_index]]
            name = sequence_name(record.sequence_id) + (f"_part_{part}" if part > 1 else "")
            for eye in EYES:
                export_image(source, record.frame_index, eye, _file(root, "final", name, eye, place, "png"), log)
                if follows and last is not None:
                    found = flow_matches(last[0].frame, record.frame, eye, last[1][eye], passes[eye])
                    _write_flow(root, name, eye, place - 1, found)
                    log.lost(_BACKGROUND, int(np.count_nonzero(~found.known)))
            last = record, passes
    return [out]


def _write_flow(root: Path, name: str, eye: Eye, place: int, found: PixelMatches) -> None:
    path = _file(root, "flow", name, eye, place, "flo")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_flo(np.where(found.known[..., None], found.displacement_px, UNKNOWN_FLOW_PX)))
    masks = {"occlusions": found.hidden, "outofframe": found.outside, "invalid": ~found.known}
    for kind, mask in masks.items():
        path = _file(root, kind, name, eye, place, "png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(mask.astype(np.uint8) * np.uint8(255), is_piecewise_constant=True))


def _file(root: Path, kind: str, name: str, eye: Eye, place: int, suffix: str) -> Path:
    return root / kind / f"{name}_{eye}" / f"frame_{place:04d}.{suffix}"


def _require_depth(dataset: Location, source: Dataset) -> None:
    if not source.manifest.recipe.outputs.exr:
        raise ValueError(
            f"{dataset}: has no depth; render its recipe again with `exr = true` in [outputs], which changes neither "
            "poses and labels nor pictures"
        )


def _passes(source: Dataset, record: PairRecord) -> dict[Eye, SurfacePasses]:
    found: dict[Eye, SurfacePasses] = {}
    for eye in EYES:
        name = passes_file(eye)
        where = source.frames.where(record.frame_index, name)
        planes = read_passes(source.frames.read(record.frame_index, name), where, record.frame.rig.camera)
        normal = np.stack([planes[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
        found[eye] = SurfacePasses(source.part_ids(record.frame_index, eye), planes["depth.Z"], normal)
    return found


def _calibration(rig: StereoRig, largest_px: float) -> str:
    """`calib.txt`; the principal points are equal and the baseline is in millimetres."""
    camera = rig.camera
    matrix = f"[{camera.fx_px!r} 0 {camera.cx_px!r}; 0 {camera.fy_px!r} {camera.cy_px!r}; 0 0 1]"
    lines = {
        "cam0": matrix,
        "cam1": matrix,
        "doffs": 0,
        "baseline": repr(1000.0 * rig.baseline_m),
        "width": camera.width_px,
        "height": camera.height_px,
        "ndisp": math.floor(largest_px) + 1,
        "isint": 0,
        "vmin": 0,
        "vmax": math.ceil(largest_px),
        "dyavg": 0,
        "dymax": 0,
    }
    return "".join(f"{key}={value}\n" for key, value in lines.items())


def encode_pfm(values: NDArray[np.floating]) -> bytes:  # type: ignore[type-arg]
    """A PFM file of (H, W) values in float32; rows go from the bottom up, a negative scale says little-endian."""
    height, width = values.shape
    return f"Pf\n{width} {height}\n-1.0\n".encode() + values[::-1].astype("<f4").tobytes()


def encode_flo(flow_px: NDArray[np.floating]) -> bytes:  # type: ignore[type-arg]
    """A `.flo` file of (H, W, 2) displacements in float32."""
    height, width, _ = flow_px.shape
    return b"PIEH" + struct.pack("<ii", width, height) + flow_px.astype("<f4").tobytes()
