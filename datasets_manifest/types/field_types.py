"""Field types with a JSON or TOML form: arrays, rigid transforms, the stereo rig, and ranges that are drawn from."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BeforeValidator, Field, InstanceOf, PlainSerializer, model_validator

from drogue_models.frozen_model import FrozenModel
from geometry.distortion import BrownConrady, Lens, OpenCvDistortion
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, read_only
from geometry.stereo import StereoRig


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


def read_rig(value: Any) -> StereoRig:
    """A rig from what `write_rig` makes of it; a rig itself stays as it is.

    Raises:
        ValueError: a key is missing or unknown, or a value is wrong.
    """
    if isinstance(value, StereoRig):
        return value
    if not isinstance(value, dict):
        raise ValueError("rig: must be a table")
    try:
        return StereoRig(
            camera=_read_camera(value["camera"]),
            baseline_m=value["baseline_m"],
            body_from_left=RigidTransform.from_matrix(value["body_from_left"]),
            probe_tip_body_m=value["probe_tip_body_m"],
            lenses=_read_lenses(value.get("lenses")),
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"rig: missing or unknown key: {error}") from error


def _read_lenses(value: list[dict[str, Any]] | None) -> tuple[Lens, Lens] | None:
    if value is None:
        return None
    if len(value) != 2:
        raise ValueError(f"rig: lenses must be the left and the right one, got {len(value)}")
    return _read_lens(value[0]), _read_lens(value[1])


def _read_lens(value: dict[str, Any]) -> Lens:
    distortion = value["distortion"]
    # Brown-Conrady's model has no coefficient named k4.
    model = OpenCvDistortion if "k4" in distortion else BrownConrady
    return Lens(_read_camera(value["camera"]), model(**distortion), value["ideal_from_real"])


def _read_camera(value: dict[str, Any]) -> PinholeCamera:
    # Other programs may write whole numbers as 1280.0.
    sizes = {name: value[name] for name in ("width_px", "height_px")}
    whole = {name: int(size) for name, size in sizes.items() if isinstance(size, float) and size.is_integer()}
    return PinholeCamera(**(value | whole))


def write_rig(rig: StereoRig) -> dict[str, Any]:
    """The rig as plain JSON values; without `lenses` where its eyes are ideal."""
    lenses = {} if rig.lenses is None else {"lenses": [_write_lens(lens) for lens in rig.lenses]}
    return {
        "camera": asdict(rig.camera),
        "baseline_m": rig.baseline_m,
        "body_from_left": rig.body_from_left.as_matrix().tolist(),
        "probe_tip_body_m": rig.probe_tip_body_m.tolist(),
        **lenses,
    }


def _write_lens(lens: Lens) -> dict[str, Any]:
    return {
        "camera": asdict(lens.camera),
        "distortion": asdict(lens.distortion),
        "ideal_from_real": lens.ideal_from_real.tolist(),
    }


Rig = Annotated[
    InstanceOf[StereoRig],
    BeforeValidator(read_rig),
    PlainSerializer(write_rig, return_type=dict[str, Any]),
]


Fraction = Annotated[float, Field(ge=0, le=1)]


class Range(FrozenModel):
    """A uniform distribution between `low` and `high`, or a constant; in TOML also `[low, high]` or a number."""

    low: float
    high: float

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, value: object) -> object:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return {"low": value, "high": value}
        if isinstance(value, list | tuple) and len(value) == 2:
            return {"low": value[0], "high": value[1]}
        return value

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low end {self.low:g} is above high end {self.high:g}")
        return self

    def within(self, low: float, high: float, name: str) -> None:
        """Check that the whole range lies in [low, high].

        Raises:
            ValueError: it does not; names the field.
        """
        if not (low <= self.low and self.high <= high):
            raise ValueError(f"{name}: must lie in [{low:g}, {high:g}], got [{self.low:g}, {self.high:g}]")
