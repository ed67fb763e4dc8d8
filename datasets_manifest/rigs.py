"""The rigs that ship: the paper's geometry with three sensors, and the table that adapts one."""

from __future__ import annotations

from pydantic import Field, ValidationError

from datasets_manifest.frame import Sensor
from datasets_manifest.json_types import FrozenModel
from drogue_models.presets import explain
from geometry.pinhole import PinholeCamera
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


class _RigTable(FrozenModel):
    """A shipped rig with changes."""

    preset: str
    width_px: int | None = Field(default=None, ge=16, le=16384)
    height_px: int | None = Field(default=None, ge=16, le=16384)
    focal_px: float | None = Field(default=None, gt=0, le=1e6)
    baseline_m: float | None = Field(default=None, gt=0, le=100)
    output_bits: int | None = None
    encoding: str | None = None


def resolve_rig(value: object) -> tuple[StereoRig, Sensor]:
    """Rig and sensor from a preset's name, or from a table that changes one.

    A changed image size keeps the principal point in the middle.

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
            for key, change in (("output_bits", table.output_bits), ("encoding", table.encoding))
            if change is not None
        }
        sensor = Sensor.model_validate({**sensor.model_dump(), **changes})
        return StereoRig(camera, table.baseline_m or rig.baseline_m), sensor
    except ValidationError as error:
        raise ValueError(f"rig: {explain(error)}") from error
    except ValueError as error:
        raise ValueError(f"rig: {error}") from error
