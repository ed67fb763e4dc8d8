"""Results of pose estimators, one for each frame, and the JSON-lines file that holds them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError

from datasets_manifest.atomic import open_text_atomic
from datasets_manifest.types.field_types import Matrix6, Transform
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain
from drogue_models.untrusted_files import open_regular, parse_json
from geometry.stereo import Eye

_MOST_LINE_BYTES = 2**24

TANGENT = "left: t' = t + dt, R' = exp([w]x) R; order dt [m], w [rad]"


def _is_none(value: float | None) -> bool:
    return value is None


class Feature(FrozenModel):
    """One measured image point.

    Attributes:
        eye: which image.
        index: of the marker in the drogue's order; `hub` for the hub.
        center_px: measured centre.
        cov_px2: (2, 2) covariance of the centre, row-major. [px^2]
        used: whether the pose was computed from it.
    """

    eye: Eye
    index: int | Literal["hub"]
    center_px: tuple[float, float]
    cov_px2: tuple[tuple[float, float], tuple[float, float]]
    used: bool


class Mode(FrozenModel):
    """One of several poses that explain the images."""

    left_from_drogue: Transform
    weight: float = Field(ge=0, le=1)


class Region(FrozenModel):
    """The search region of the drogue in one image.

    Attributes:
        eye: which image.
        box_xywh_px: x, y of the low corner, width, height in pixel-centre coordinates; may reach over the image's edge.
        source: `detector`, the name of the tracker, or `other eye` where only that one had a detection.
        score: confidence, 0 to 1.
    """

    eye: Eye
    box_xywh_px: tuple[float, float, float, float]
    source: str = Field(min_length=1, max_length=80)
    score: float = Field(ge=0, le=1)


class Motion(FrozenModel):
    """Motion of the drogue relative to the left camera, at the time of the images.

    Attributes:
        velocity_m_s: of the drogue's origin, in the left camera's axes. [m/s]
        rate_rad_s: of its attitude, `R' = [w]x R`, in the left camera's axes. [rad/s]
        covariance: (6, 6) of both in this order.
    """

    velocity_m_s: tuple[float, float, float]
    rate_rad_s: tuple[float, float, float]
    covariance: Matrix6


class Docking(FrozenModel):
    """The drogue relative to the probe, in the receiver's body axes: forward, right, down.

    Attributes:
        mouth_from_tip_m: (3,) centre of the drogue's rim from the probe's tip. [m]
        mouth_sd_m: (3,) standard deviations of `mouth_from_tip_m`. [m]
        closure_m_s: rate at which the forward component shrinks; null where the motion is not known. [m/s]
        miss_m: predicted distance of the tip from the drogue's axis when it reaches the plane of the rim, at constant
            velocities; null unless they close. [m]
        miss_sd_m: standard deviation of `miss_m`. [m]
        contact_s: predicted time until then; null unless they close. [s]
        captured: whether `miss_m` lies within the capture radius; null where there is no `miss_m`.
        capture_radius_m: null for the drogue's own. [m]
    """

    mouth_from_tip_m: tuple[float, float, float]
    mouth_sd_m: tuple[float, float, float]
    closure_m_s: float | None = None
    miss_m: float | None = Field(default=None, ge=0)
    miss_sd_m: float | None = Field(default=None, ge=0)
    contact_s: float | None = Field(default=None, ge=0)
    captured: bool | None = None
    capture_radius_m: float | None = Field(default=None, gt=0)


class PoseEstimate(FrozenModel):
    """A pose of the drogue.

    Attributes:
        frame_index: of the pair.
        method: name of the method.
        left_from_drogue: modulo the markers' symmetry; with the likeliest roll where lamps blink.
        roll_probability: of that roll among those that the markers' symmetry leaves open, by the blinking of the lamps
            in this pair and those before; None where lamps do not blink.
        note: what the method says about this pose in one sentence, or empty.
        covariance: (6, 6) in the tangent space that `tangent` names; None where the method gives none.
        modes: every pose that explains the images, the best first; weights sum to 1.
        features: the measured image points.
        stage_s: computing time by stage. [s]
        regions: search regions, at most one an eye.
        motion: as estimated by a filter from two measurements or more, or None.
        docking: where it was requested.
        latency_s: from the arrival of the images to this result, in real time. [s]
        time_s: of the images, in real time. [s]
    """

    status: Literal["fix"] = "fix"
    frame_index: int = Field(ge=0)
    method: str = Field(min_length=1, max_length=80)
    left_from_drogue: Transform
    covariance: Matrix6 | None = None
    tangent: str = TANGENT
    modes: tuple[Mode, ...] = ()
    features: tuple[Feature, ...] = ()
    stage_s: dict[str, float] = Field(default_factory=dict)
    regions: tuple[Region, ...] = ()
    motion: Motion | None = None
    docking: Docking | None = None
    latency_s: float | None = Field(default=None, ge=0)
    time_s: float | None = Field(default=None, exclude_if=_is_none)
    roll_probability: float | None = Field(default=None, ge=0, le=1, exclude_if=_is_none)
    note: str = Field(default="", exclude_if=lambda note: not note)


class NoFix(FrozenModel):
    """No pose, with the reason.

    Attributes:
        frame_index: of the pair.
        method: name of the method.
        reason: why there is none.
        features: the measured image points.
        stage_s: computing time by stage. [s]
        regions: search regions, at most one an eye.
        latency_s: from the arrival of the images to this result, in real time. [s]
        time_s: of the images, in real time. [s]
    """

    status: Literal["no_fix"] = "no_fix"
    frame_index: int = Field(ge=0)
    method: str = Field(min_length=1, max_length=80)
    reason: str = Field(min_length=1)
    features: tuple[Feature, ...] = ()
    stage_s: dict[str, float] = Field(default_factory=dict)
    regions: tuple[Region, ...] = ()
    latency_s: float | None = Field(default=None, ge=0)
    time_s: float | None = Field(default=None, exclude_if=_is_none)


Estimate = PoseEstimate | NoFix
_ADAPTER: TypeAdapter[Estimate] = TypeAdapter(Annotated[Estimate, Field(discriminator="status")])


def write_estimates(path: Path, estimates: Iterable[Estimate]) -> int:
    """Write one JSON object a line, replacing `path` only once all are written.

    Returns:
        The number of estimates.

    Raises:
        OSError: the file cannot be written; names it. An existing file stays as it was.
    """
    count = 0
    with open_text_atomic(path) as stream:
        for estimate in estimates:
            stream.write(estimate.model_dump_json() + "\n")
            count += 1
    return count


def read_estimates(path: Path) -> Iterator[Estimate]:
    """Estimates from a JSON-lines file, by droguekit or by any other program.

    Raises:
        ValueError: the file cannot be read, or a line is not an estimate or too long; names file and line.
    """
    try:
        with open_regular(path) as stream:
            number = 0
            while line := stream.readline(_MOST_LINE_BYTES + 1):
                number += 1
                if len(line) > _MOST_LINE_BYTES:
                    raise ValueError(f"{path}, line {number}: has more than {_MOST_LINE_BYTES} bytes")
                if not line.strip():
                    continue
                try:
                    yield _ADAPTER.validate_python(parse_json(line))
                except ValidationError as error:
                    raise ValueError(f"{path}, line {number}: not a pose estimate: {explain(error)}") from error
                except ValueError as error:
                    raise ValueError(f"{path}, line {number}: not JSON: {error}") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
