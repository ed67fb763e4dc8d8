"""The `[rig]` and `[exposure]` sections of a recipe: shipped rigs, changes to them, lenses, exposure and rangefinder.

The shipped rigs have the seed paper's geometry with three sensors, one of them also behind an infrared filter, and
ideal or real lenses.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from datasets_manifest.calibration.baseline_units import BASELINE_UNITS_M
from datasets_manifest.random_streams import seeded_generator
from datasets_manifest.types.field_types import Range
from datasets_manifest.types.frame import Optics, Sensor
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain
from drogue_models.untrusted_files import parse_toml, read_text
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import exp_twist
from geometry.stereo import StereoRig, paper_rig

# onsemi AR0135AT product brief: 42 ke-/(lux s), 40.7 dB maximum signal to noise, 67.7 dB dynamic range; full well
# 10^(40.7/10) = 11.7 ke- and read noise 11.7 ke-/10^(67.7/20) = 4.8 e- follow. PRNU is our assumption.
_AR0135 = {
    "full_well_e": 11_700.0,
    "read_noise_e": 4.8,
    "responsivity_e_per_lux_s": 42_000.0,
    "prnu_fraction": 0.01,
    "psf_sigma_px": 0.5,
    "black_level_dn": 64,
}

SENSORS: dict[str, Sensor] = {
    "rgb-ideal": Sensor(name="rgb-ideal", color="rgb", **_AR0135),
    "paper-colour": Sensor(name="paper-colour", color="bayer", **_AR0135),
    "mono": Sensor(name="mono", color="mono", **_AR0135),
}
# Behind a filter for 850 nm. Sunlight outside the air from 825 to 875 nm is 50.2 W/m2 (ASTM G173-03) of 127,500 lux
# (IES Handbook). A filter's transmission of 0.9 and a quantum efficiency of 0.2 there are our assumptions; the area
# of a pixel and the energy of a photon turn the rest into electrons.
_BAND_NM, _BAND_W_PER_M2, _SUN_LUX, _TRANSMISSION, _QUANTUM_EFFICIENCY = 850.0, 50.2, 127_500.0, 0.9, 0.2
_PIXEL_M2, _PHOTON_J = 3.75e-6**2, 6.626_070_15e-34 * 299_792_458 / (_BAND_NM * 1e-9)
_ELECTRONS_PER_J = _QUANTUM_EFFICIENCY / _PHOTON_J
SENSORS["mono-850"] = SENSORS["mono"].model_copy(
    update={
        "name": "mono-850",
        "responsivity_e_per_lux_s": round(_BAND_W_PER_M2 / _SUN_LUX * _TRANSMISSION * _PIXEL_M2 * _ELECTRONS_PER_J, -1),
        "band_nm": _BAND_NM,
    }
)
SENSORS["paper-real"] = SENSORS["rgb-ideal"].model_copy(
    update={
        "name": "paper-real",
        "optics": Optics(natural_vignetting=True, mechanical_falloff_fraction=0.15, focus_distance_m=15.0),
    }
)


class Eyes(FrozenModel):
    """Deviations of the eyes of a rig from ideal ones, drawn once for the whole dataset, independently for each eye.

    Attributes:
        k1, k2, p1, p2, k3: Brown-Conrady coefficients of both lenses.
        principal_point_px: largest shift of the principal points along each axis, in either direction. [px]
        focal_fraction: largest relative error of each focal length.
        right_rotation_deg: largest rotation of the right eye about each of its axes, in either direction. [deg]
    """

    k1: Range = Range(low=0, high=0)
    k2: Range = Range(low=0, high=0)
    p1: Range = Range(low=0, high=0)
    p2: Range = Range(low=0, high=0)
    k3: Range = Range(low=0, high=0)
    principal_point_px: float = Field(default=0.0, ge=0, le=500)
    focal_fraction: float = Field(default=0.0, ge=0, le=0.2)
    right_rotation_deg: float = Field(default=0.0, ge=0, le=5)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name in ("k1", "k2", "p1", "p2", "k3"):
            getattr(self, name).within(-2, 2, name)
        return self


_CALIBRATION_SUFFIXES = (".yaml", ".yml", ".xml", ".json")

# A good 8 mm lens of a machine vision camera, and a mount adjusted by hand (our assumption).
_REAL_EYES = Eyes(
    k1=Range(low=-0.08, high=-0.04),
    k2=Range(low=0.0, high=0.05),
    p1=Range(low=-2e-4, high=2e-4),
    p2=Range(low=-2e-4, high=2e-4),
    principal_point_px=8.0,
    focal_fraction=0.003,
    right_rotation_deg=0.25,
)


class _RigTable(FrozenModel):
    """The table of a shipped rig with changes.

    A calibration sets what it measured: focal lengths, baseline and lenses; the image's size only where its files hold
    one.
    """

    preset: str
    width_px: int | None = Field(default=None, ge=16, le=16384)
    height_px: int | None = Field(default=None, ge=16, le=16384)
    focal_px: float | None = Field(default=None, gt=0, le=1e6)
    baseline_m: float | None = Field(default=None, gt=0, le=100)
    probe_tip_body_m: tuple[float, float, float] | None = None
    output_bits: int | None = None
    encoding: str | None = None
    noise_free: bool | None = None
    optics: Optics | None = None
    eyes: Eyes | None = None
    calibration: tuple[str, ...] | None = None
    calibration_unit: Literal["m", "cm", "mm"] | None = None

    @field_validator("calibration", mode="before")
    @classmethod
    def _files(cls, value: object) -> object:
        files = _calibration_files(value)
        if not isinstance(files, list) or len(files) not in (1, 2):
            raise ValueError(f"must be one file, or two that belong together, got {value}")
        return files

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.calibration is None:
            if self.calibration_unit is not None:
                raise ValueError("calibration_unit: is of a calibration; name its file as `calibration`")
            return self
        given = [key for key in ("focal_px", "baseline_m", "eyes") if getattr(self, key) is not None]
        if given:
            raise ValueError(f"{', '.join(given)}: the calibration sets it; leave it out")
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px, height_px: give both, or none where the calibration holds them")
        return self

    def calibrated_rig(self, rig: StereoRig) -> StereoRig:
        """The rig with the cameras of the calibration.

        Raises:
            ValueError: the files are no calibration.
        """
        # Loads OpenCV and the YAML reader, which other rigs do without.
        from datasets_manifest.calibration.calibration_reader import read_calibration

        size_px = None if self.width_px is None or self.height_px is None else (self.width_px, self.height_px)
        paths = [Path(file) for file in self.calibration or ()]
        measured = read_calibration(paths, BASELINE_UNITS_M[self.calibration_unit or "m"], size_px).rig
        return replace(rig, camera=measured.camera, baseline_m=measured.baseline_m, lenses=measured.lenses)


def _calibration_files(value: object) -> object:
    """The files of a `calibration`, which may be one name; anything else as it is."""
    return [value] if isinstance(value, str) else value


def read_rig_file(text: str, where: str) -> dict[str, Any]:
    """The table of a rig's own file.

    Args:
        text: TOML.
        where: the file, for errors.

    Raises:
        ValueError: not TOML, or no preset to start from.
    """
    try:
        table = parse_toml(text)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if "preset" not in table:
        raise ValueError(f"{where}: preset: name the shipped rig to start from; there are {', '.join(SENSORS)}")
    return table


def load_rig(value: object, base: Path | None = None) -> object:
    """A rig's name or table as it is, and the table of a `.toml` file that it names.

    Files of a calibration are then named as seen from the current folder.

    Args:
        value: of the recipe.
        base: folder that relative paths start from; those of a rig's file start from its own folder.

    Raises:
        ValueError: the file cannot be read.
    """
    folder = base or Path()
    if isinstance(value, dict):
        return _with_calibration_paths(value, folder)
    if not (isinstance(value, str) and value.endswith(".toml")):
        if isinstance(value, str) and value.endswith(_CALIBRATION_SUFFIXES):
            raise ValueError(
                f'rig: {value}: write a calibration as `[rig]`, `preset = "mono"`, `calibration = "{value}"`'
            )
        return value
    path = folder / value
    try:
        text = read_text(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not valid TOML: {error}") from error
    return _with_calibration_paths(read_rig_file(text, str(path)), path.parent)


def _with_calibration_paths(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    files = _calibration_files(table.get("calibration"))
    if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
        return table
    return {**table, "calibration": [str(folder / file) for file in files]}


def resolve_rig(value: object, seed: int = 0) -> tuple[StereoRig, Sensor]:
    """Rig and sensor from a preset's name, or from a table that changes one.

    A changed image size keeps the principal point in the middle.

    Args:
        value: name or table.
        seed: of the dataset, for the real lenses.

    Raises:
        ValueError: unknown preset or key.
    """
    try:
        table = _RigTable.model_validate({"preset": value} if isinstance(value, str) else value)
        if table.preset not in SENSORS:
            raise ValueError(f"preset: no rig named {table.preset!r}; there are {', '.join(SENSORS)}")
        rig, sensor = paper_rig(), SENSORS[table.preset]
        width_px = table.width_px or rig.camera.width_px
        height_px = table.height_px or rig.camera.height_px
        focal_px = table.focal_px or rig.camera.fx_px
        camera = PinholeCamera(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)
        changes = {
            key: change
            for key, change in (
                ("output_bits", table.output_bits),
                ("encoding", table.encoding),
                ("noise_free", table.noise_free),
                ("optics", table.optics),
            )
            if change is not None
        }
        sensor = Sensor.model_validate({**sensor.model_dump(), **changes})
        tip_m = rig.probe_tip_body_m if table.probe_tip_body_m is None else np.array(table.probe_tip_body_m)
        rig = replace(rig, camera=camera, baseline_m=table.baseline_m or rig.baseline_m, probe_tip_body_m=tip_m)
        if table.calibration is not None:
            return table.calibrated_rig(rig), sensor
        eyes = table.eyes or (_REAL_EYES if table.preset == "paper-real" else None)
        return rig if eyes is None else replace(rig, lenses=_draw_lenses(eyes, camera, seed)), sensor
    except ValidationError as error:
        raise ValueError(f"rig: {explain(error)}") from error
    except ValueError as error:
        raise ValueError(f"rig: {error}") from error


def _draw_lenses(eyes: Eyes, camera: PinholeCamera, seed: int) -> tuple[Lens, Lens]:
    """The left and the right lens; the left eye's axes are the rig's."""
    # Differs from all streams of frames and scenes, whose keys are longer.
    rng = seeded_generator(seed)
    lenses = []
    for is_right in (False, True):
        shape = [rng.uniform(limits.low, limits.high) for limits in (eyes.k1, eyes.k2, eyes.p1, eyes.p2, eyes.k3)]
        du, dv = rng.uniform(-1.0, 1.0, 2) * eyes.principal_point_px
        scale_x, scale_y = 1.0 + rng.uniform(-1.0, 1.0, 2) * eyes.focal_fraction
        turn = rng.uniform(-1.0, 1.0, 3) * np.radians(eyes.right_rotation_deg) * is_right
        real = PinholeCamera(
            camera.width_px,
            camera.height_px,
            camera.fx_px * float(scale_x),
            camera.fy_px * float(scale_y),
            camera.cx_px + float(du),
            camera.cy_px + float(dv),
        )
        rotation = exp_twist(np.concatenate([np.zeros(3), turn])).rotation
        lenses.append(Lens(real, BrownConrady(*map(float, shape)), rotation))
    return lenses[0], lenses[1]


class ExposureLaw(FrozenModel):
    """How the meter sets the exposure: with the time first and, once that is at its limit, with the gain.

    Attributes:
        time_s: fixed exposure time; without it the meter chooses within `auto_time_s`. [s]
        auto_time_s: shortest and longest time that the meter chooses. [s]
        auto_gain: range of the gain; a single number is a fixed gain. A gain below 1 darkens the picture, and its time
            is that of gain 1.
        auto_meter: what the meter measures: `view`, the brighter of the view's mean and a white plate that faces the
            camera; `plate`, the plate alone, as a meter that measures the drogue and not the sky behind it; or
            `highlights`, as `view`, but nine tenths of the view stay below white.
        auto_level_fraction: level at which the meter puts that, as a share of the full well or, at gains above 1, of
            the signal that saturates the converter.
        f_number: of the lens; with the time it sets how much light the sensor receives.
    """

    time_s: float | None = Field(default=None, gt=0, le=1)
    auto_time_s: Range = Range(low=20e-6, high=20e-3)
    auto_gain: Range = Range(low=1, high=1)
    auto_meter: Literal["view", "plate", "highlights"] = Field(default="view", exclude_if=lambda meter: meter == "view")
    auto_level_fraction: float = Field(default=0.7, gt=0, le=2)
    f_number: float = Field(default=2.8, ge=0.5, le=64)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.auto_time_s.within(1e-6, 1, "auto_time_s")
        self.auto_gain.within(0.1, 64, "auto_gain")
        return self


class Rangefinder(FrozenModel):
    """A laser rangefinder beside the left camera, which a bench experiment takes for the truth.

    A reading is the distance of the rim centre along the optical axis, plus an offset and noise, rounded. The defaults
    are those of a hand-held meter for building sites, whose data sheets give +-2 mm at two standard deviations
    (ISO 16331-1) and a last digit of 1 mm; the offset is our assumption for a zero mark set by hand.

    Attributes:
        offset_m: largest distance, in either direction, between the rangefinder's zero and the camera's; drawn once a
            dataset. [m]
        noise_m: standard deviation of a reading. [m]
        resolution_m: step of its last digit; 0 for no rounding. [m]
    """

    offset_m: float = Field(default=0.003, ge=0, le=1)
    noise_m: float = Field(default=0.001, ge=0, le=1)
    resolution_m: float = Field(default=0.001, ge=0, le=1)
