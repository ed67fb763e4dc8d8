"""Automatic exposure."""

from __future__ import annotations

import numpy as np

from datasets_manifest.recipe.rigs import ExposureLaw
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.frame import Exposure, Sensor
from drogue_models.parameters import WHITE_PAINT
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from scenes.environment_radiance import EnvironmentRadiance, environment_radiance
from scenes.sky.photometry import luminance

_METER_COLUMNS, _METER_ROWS = 16, 12
_DARKEST_CD_M2 = 1e-9  # a millionth of a starlit sky; the limits of time and gain are reached long before


def automatic_exposure(
    law: ExposureLaw, environment: Environment, camera: PinholeCamera, world_from_left: RigidTransform, sensor: Sensor
) -> Exposure:
    """Exposure that brings the luminance that the law meters, see `ExposureLaw`, to the law's level.

    A longer time comes first, because it collects more light; gain only makes up for what the limits of time leave.
    """
    gain = law.auto_gain
    if law.time_s is not None and gain.low == gain.high:
        return Exposure(time_s=law.time_s, f_number=law.f_number, gain=gain.low)
    ambient = environment_radiance(environment)
    plate = ambient.plate_illuminance_lux(-world_from_left.rotation[:, 2]) * np.array(WHITE_PAINT) / np.pi
    brightest = max(float(luminance(plate)), _DARKEST_CD_M2)
    if law.auto_meter == "view":
        brightest = max(brightest, _mean_luminance(ambient, camera, world_from_left))
    one_second = Exposure(time_s=1.0, f_number=law.f_number)
    wanted_s = law.auto_level_fraction * sensor.full_well_e / (sensor.electrons_per_cd_m2(one_second) * brightest)
    time_s = law.time_s
    if time_s is None:
        nearest_to_one = min(max(1.0, gain.low), gain.high)
        time_s = float(np.clip(wanted_s / nearest_to_one, law.auto_time_s.low, law.auto_time_s.high))
    gain_used = float(np.clip(wanted_s / time_s, gain.low, gain.high))
    return Exposure(time_s=time_s, f_number=law.f_number, gain=gain_used)


def _mean_luminance(ambient: EnvironmentRadiance, camera: PinholeCamera, world_from_left: RigidTransform) -> float:
    """Mean luminance of the camera's view without a drogue. [cd/m2]"""
    u, v = np.meshgrid(
        (np.arange(_METER_COLUMNS) + 0.5) * camera.width_px / _METER_COLUMNS,
        (np.arange(_METER_ROWS) + 0.5) * camera.height_px / _METER_ROWS,
    )
    rays = world_from_left.rotate(camera.rays(np.stack([u, v], axis=-1)))
    view = ambient.radiance((rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32))
    return float(luminance(view).mean())
