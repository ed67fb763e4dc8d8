"""Radiance and passes of one eye as a single-part float32 EXR file."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import OpenEXR

from render.engine import EyeRadiance


def encode_passes(eye: EyeRadiance) -> bytes:
    """Bytes of the file: `R G B` [cd/m2], `depth.Z` (planar [m], inf for sky), `normal.X/Y/Z` (eye's frame), `id.X`."""
    channels = {
        **{name: eye.radiance_cd_m2[..., index] for index, name in enumerate("RGB")},
        "depth.Z": eye.depth_m,
        **{f"normal.{name}": eye.normal[..., index] for index, name in enumerate("XYZ")},
        "id.X": eye.part_id.astype(np.float32),
    }
    # ZIP is what cv2, Mitsuba and Blender all read.
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    contiguous = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in channels.items()}
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        path = Path(folder) / "passes.exr"
        OpenEXR.File(header, contiguous).write(str(path))
        return path.read_bytes()
