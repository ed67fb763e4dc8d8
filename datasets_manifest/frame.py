"""One frame to be rendered, complete: everything that the picture and its truth depend on."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.json_types import FrozenModel, Points3, Rig, Transform, Vector6
from drogue_models.parameters import DrogueParameters, ReflectanceRgb
from geometry.se3 import RigidTransform, exp_twist

Elevation = Annotated[float, Field(ge=-90, le=90)]


class CloudLayer(FrozenModel):
    """A flat layer of broken cloud.

    Attributes:
        height_above_camera_m: negative when the receiver flies above it. [m]
        cover_fraction: share of the layer that is cloud.
        feature_size_m: size of the largest clouds. [m]
        optical_depth: in the thick parts, vertically.
        texture_seed: of its pattern.
    """

    height_above_camera_m: float = Field(ge=-15000, le=15000)
    cover_fraction: float = Field(ge=0, le=1)
    feature_size_m: float = Field(gt=0, le=1e5)
    optical_depth: float = Field(gt=0, le=200)
    texture_seed: int = Field(ge=0)

    @model_validator(mode="after")
    def _not_inside(self) -> Self:
        if abs(self.height_above_camera_m) < 100:
            raise ValueError("height_above_camera_m: the camera must stay 100 m clear of a layer without thickness")
        return self


class Environment(FrozenModel):
    """Sky, sun, air and ground of one scene, in world axes (x east, y north, z up).

    Attributes:
        sun_elevation_deg, sun_azimuth_deg: direction to the sun; azimuth from east towards north. [deg]
        turbidity: Linke-like turbidity of Preetham's model, 2 very clear to 6 hazy.
        visibility_m: meteorological range (2 % contrast), which sets the extinction of the air. [m]
        altitude_m: of the camera above ground. [m]
        ground_reflectance_rgb: mean diffuse reflectance of the ground or sea.
        ground_texture_seed: of its pattern.
        cloud: a cloud layer, or none.
    """

    sun_elevation_deg: float = Field(ge=1, le=90)
    sun_azimuth_deg: float = Field(ge=-360, le=360)
    turbidity: float = Field(ge=1.9, le=10)
    visibility_m: float = Field(ge=500, le=400_000)
    altitude_m: float = Field(ge=10, le=20_000)
    ground_reflectance_rgb: ReflectanceRgb
    ground_texture_seed: int = Field(ge=0)
    cloud: CloudLayer | None = None

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of the air near the camera (Koschmieder, contrast 2 %). [1/m]"""
        return 3.912 / self.visibility_m


class Exposure(FrozenModel):
    """Shutter and aperture of both eyes."""

    time_s: float = Field(gt=0, le=1)
    f_number: float = Field(ge=0.5, le=64)
    gain: float = Field(default=1.0, ge=0.1, le=64)

    @property
    def lux_per_cd_m2(self) -> float:
        """Illuminance of the sensor per luminance of the scene, for a lens without loss, focused far away. [lux m2/cd]

        Source: camera equation E = pi L / (4 N^2), EMVA Standard 1288.
        """
        return math.pi / (4.0 * self.f_number**2)


class Sensor(FrozenModel):
    """What turns radiance into numbers.

    Attributes:
        name: the preset's name.
        color: `rgb` three samples a pixel, `bayer` one (RGGB mosaic), `mono` none.
        full_well_e, read_noise_e: [electrons]
        responsivity_e_per_lux_s: electrons per pixel for white light. [e-/(lux s)]
        prnu_fraction: standard deviation of the pixels' gains.
        psf_sigma_px: Gaussian blur of lens and pixel crosstalk, after the pixel's box. [px]
        adc_bits, output_bits: of the converter and of the stored image.
        black_level_dn: added before the converter clips. [DN of adc_bits]
        encoding: `linear`, or `gamma` (the sRGB curve).
    """

    name: str = Field(min_length=1, max_length=80)
    color: Literal["rgb", "bayer", "mono"]
    full_well_e: float = Field(gt=0, le=1e7)
    read_noise_e: float = Field(ge=0, le=1e4)
    responsivity_e_per_lux_s: float = Field(gt=0, le=1e7)
    prnu_fraction: float = Field(ge=0, le=0.2)
    psf_sigma_px: float = Field(ge=0, le=10)
    adc_bits: Literal[12] = 12
    output_bits: Literal[8, 12] = 8
    black_level_dn: int = Field(ge=0, le=1000)
    encoding: Literal["linear", "gamma"] = "linear"

    def electrons_per_cd_m2(self, exposure: Exposure) -> float:
        """Electrons of one pixel per luminance of the scene. [e- m2/cd]"""
        return self.responsivity_e_per_lux_s * exposure.lux_per_cd_m2 * exposure.time_s


class FrameSpec(FrozenModel):
    """One stereo pair to make. Truth in all that it holds; navigation never sees it.

    Attributes:
        seed: of the dataset; with `frame_index` it keys every random stream.
        frame_index: place in the dataset.
        family: the recipe's name for these conditions, for tables.
        scene_id: which drawn environment; splits are by scene.
        sequence_id: which sequence, or None for single frames.
        time_s: mid-exposure. [s]
        drogue: what hangs there, or None for an empty frame.
        left_from_drogue: pose at mid-exposure, or None for an empty frame.
        world_from_left: world axes are x east, y north, z up; origin at the left eye.
        left_twist_per_s, drogue_twist_per_s: (6,) body twists over the exposure, each in its own frame, relative to
            axes that fly along with the tanker: velocity [m/s], then angular velocity [rad/s].
        left_from_tanker: tanker frame x aft, y right wing, z up at the pod's hose exit, or None.
        hose_nodes_left_m: (K, 3) centre line from coupling to pod in the left camera at mid-exposure, or None. [m]
        rig, sensor, exposure, environment: as named.
    """

    seed: int = Field(ge=0)
    frame_index: int = Field(ge=0)
    family: str = "clear"
    scene_id: int = Field(ge=0)
    sequence_id: int | None = Field(default=None, ge=0)
    time_s: float
    drogue: DrogueParameters | None
    left_from_drogue: Transform | None
    world_from_left: Transform
    left_twist_per_s: Vector6
    drogue_twist_per_s: Vector6
    left_from_tanker: Transform | None
    hose_nodes_left_m: Points3 | None
    rig: Rig
    sensor: Sensor
    exposure: Exposure
    environment: Environment

    @model_validator(mode="after")
    def _drogue_has_a_pose(self) -> Self:
        if (self.drogue is None) != (self.left_from_drogue is None):
            raise ValueError("left_from_drogue: must be given exactly when there is a drogue")
        return self

    def left_from_drogue_at(self, offset_s: float) -> RigidTransform:
        """Pose of the drogue in the left camera, `offset_s` after mid-exposure.

        Raises:
            ValueError: the frame has no drogue.
        """
        if self.left_from_drogue is None:
            raise ValueError("left_from_drogue_at: the frame has no drogue")
        camera_moved = exp_twist(-offset_s * self.left_twist_per_s)
        drogue_moved = exp_twist(offset_s * self.drogue_twist_per_s)
        pose: RigidTransform = camera_moved @ self.left_from_drogue @ drogue_moved
        return pose

    def world_from_left_at(self, offset_s: float) -> RigidTransform:
        """Pose of the left camera in the world, `offset_s` after mid-exposure."""
        pose: RigidTransform = self.world_from_left @ exp_twist(offset_s * self.left_twist_per_s)
        return pose
