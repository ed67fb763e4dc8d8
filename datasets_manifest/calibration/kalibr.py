"""The rig's calibration as Kalibr writes and reads it: a camera chain."""

from __future__ import annotations

import numpy as np

from datasets_manifest.calibration.opencv_matrices import opencv_stereo_matrices
from datasets_manifest.calibration.yaml_text import yaml_list
from geometry.stereo import StereoRig

KALIBR_FILE = "kalibr_camchain.yaml"


def kalibr_fault(rig: StereoRig) -> str | None:
    """Why a rig has no Kalibr camera chain, or None."""
    if any(lens.distortion.k3 != 0 for lens in rig.lenses or ()):
        return "Kalibr's radtan model has no k3, which the rig's lenses have"
    return None


def kalibr_camchain(rig: StereoRig) -> str:
    """The text of `camchain.yaml`, of the images as they are delivered.

    `T_cn_cnm1` takes points from the camera before (cam0, the left) to this one (cam1, the right). [m]

    Raises:
        ValueError: the rig's distortion is not one of Kalibr's.

    Source: Kalibr's documentation of its YAML formats; models `pinhole` (fu, fv, pu, pv) and `radtan` (k1, k2, p1, p2).
    """
    fault = kalibr_fault(rig)
    if fault is not None:
        raise ValueError(f"rig: {fault}; use another calibration format")
    m = opencv_stereo_matrices(rig)
    right_from_left = np.vstack([np.hstack([m["R"], m["T"]]), [0.0, 0.0, 0.0, 1.0]])
    lines = []
    for index, name in enumerate(("cam0", "cam1")):
        matrix, distortion = m[f"M{index + 1}"], m[f"D{index + 1}"][0]
        lines.append(f"{name}:")
        if index:
            lines += ["  T_cn_cnm1:", *(f"  - {yaml_list(row)}" for row in right_from_left)]
        lines += [
            f"  cam_overlaps: [{1 - index}]",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {yaml_list(distortion[:4])}",
            "  distortion_model: radtan",
            f"  intrinsics: {yaml_list([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])}",
            f"  resolution: [{rig.camera.width_px}, {rig.camera.height_px}]",
            f"  rostopic: /stereo/{('left', 'right')[index]}/image_raw",
        ]
    return "\n".join(lines) + "\n"
