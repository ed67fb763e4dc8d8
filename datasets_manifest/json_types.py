"""Field types with a JSON form: arrays, rigid transforms, the stereo rig."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, InstanceOf, PlainSerializer

from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, read_only
from geometry.stereo import StereoRig


class FrozenModel(BaseModel):
    """A value that is checked when it is made, refuses unknown keys and never changes."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _array_type(shape: tuple[int, ...]) -> Any:
    return Annotated[
        InstanceOf[np.ndarray],  # type: ignore[type-arg]
        BeforeValidator(lambda value: read_only(value, shape, "array")),
        PlainSerializer(lambda value: value.tolist(), return_type=list[Any]),
    ]


Vector3 = _array_type((3,))
Vector6 = _array_type((6,))
Matrix6 = _array_type((6, 6))
Points3 = _array_type((-1, 3))


def _read_transform(value: Any) -> RigidTransform:
    return value if isinstance(value, RigidTransform) else RigidTransform.from_matrix(value)


Transform = Annotated[
    InstanceOf[RigidTransform],
    BeforeValidator(_read_transform),
    PlainSerializer(lambda value: value.as_matrix().tolist(), return_type=list[list[float]]),
]
"""A rigid transform; on disk a 4x4 row-major list."""


def _read_rig(value: Any) -> StereoRig:
    if isinstance(value, StereoRig):
        return value
    if not isinstance(value, dict):
        raise ValueError("rig: must be a table")
    try:
        return StereoRig(
            camera=PinholeCamera(**value["camera"]),
            baseline_m=value["baseline_m"],
            body_from_left=RigidTransform.from_matrix(value["body_from_left"]),
            probe_tip_body_m=value["probe_tip_body_m"],
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"rig: missing or unknown key: {error}") from error


def write_rig(rig: StereoRig) -> dict[str, Any]:
    """The rig as plain JSON values."""
    camera = rig.camera
    return {
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "fx_px": camera.fx_px,
            "fy_px": camera.fy_px,
            "cx_px": camera.cx_px,
            "cy_px": camera.cy_px,
        },
        "baseline_m": rig.baseline_m,
        "body_from_left": rig.body_from_left.as_matrix().tolist(),
        "probe_tip_body_m": rig.probe_tip_body_m.tolist(),
    }


Rig = Annotated[
    InstanceOf[StereoRig],
    BeforeValidator(_read_rig),
    PlainSerializer(write_rig, return_type=dict[str, Any]),
]
