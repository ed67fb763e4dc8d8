"""The complete specification of one stereo pair: everything that its images and its truth depend on."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.types.appearance import DrogueCondition, Obstacle, PlacedBoard
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.field_types import Points3, Rig, Transform, Vector6
from datasets_manifest.types.video_camera import CAMERA_BAND_NM, VideoCamera
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import MAX_NEIGHBOURS
from drogue_models.surface_looks import HoseLook
from drogue_models.tankers.tanker import Tanker
from geometry.se3 import RigidTransform, exp_twist


class OtherDrogue(FrozenModel):
    """Another hose and drogue; during the exposure it moves with the drogue that is sought.

    Attributes:
        drogue: its dimensions and paint.
        condition: of its surfaces, or None when it is as new.
        left_from_drogue: pose at mid-exposure.
        hose_nodes_left_m: (K, 3) centre line of its hose from coupling to exit in the left camera. [m]
        hose_look: paint of its hose, or None for the drogue's structural paint.
        left_from_tanker: pose of the second tanker, of the first one's type, that its hose comes from; None where it
            comes from the first one.
    """

    drogue: DrogueParameters
    condition: DrogueCondition | None = None
    left_from_drogue: Transform
    hose_nodes_left_m: Points3
    hose_look: HoseLook | None = None
    left_from_tanker: Transform | None = Field(default=None, exclude_if=lambda pose: pose is None)


DropoutKind = Literal["occlusion", "out-of-view", "glare"]


class Exposure(FrozenModel):
    """Shutter, aperture and amplification of both eyes.

    Attributes:
        time_s: how long the shutter is open. [s]
        f_number: focal length over aperture.
        gain: of the amplifier before the converter; at 1 a full well gives the highest number.
    """

    time_s: float = Field(gt=0, le=1)
    f_number: float = Field(ge=0.5, le=64)
    gain: float = Field(default=1.0, ge=0.1, le=64)

    @property
    def lux_per_cd_m2(self) -> float:
        """Illuminance of the sensor per luminance of the scene, for a lossless lens focused at infinity. [lux m2/cd]

        Source: camera equation E = pi L / (4 N^2), EMVA Standard 1288.
        """
        return math.pi / (4.0 * self.f_number**2)


class Optics(FrozenModel):
    """Effects of the lens besides its point spread; the defaults switch all but scattered light off.

    Attributes:
        natural_vignetting: light falls off with the fourth power of the cosine of the angle from the axis.
        mechanical_falloff_fraction: share of the light that the lens barrel blocks in the corners of the image; it
            grows with the fourth power of the distance from the principal point.
        focus_distance_m: planar depth in focus; without it everything is sharp. [m]
        pixel_pitch_um: converts the focal length to metres, which gives the aperture. [um]
        scattered_fraction: share of the sun's or moon's light on the lens that is spread over the image as glare:
            0.01 for a clean lens, about a tenth for a fogged one (our choice).
    """

    natural_vignetting: bool = False
    mechanical_falloff_fraction: float = Field(default=0.0, ge=0, lt=1)
    focus_distance_m: float | None = Field(default=None, gt=0.05, le=1e6)
    pixel_pitch_um: float = Field(default=3.75, ge=0.5, le=100)
    # Left out for a clean lens, so that the hashes of other datasets stay those of earlier versions.
    scattered_fraction: float = Field(default=0.01, ge=0, le=0.5, exclude_if=lambda fraction: fraction == 0.01)


class Sensor(FrozenModel):
    """An image sensor and the lens before it.

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
        optics: vignetting and focus.
        noise_free: whether pictures lack the noise of light and readout and the spread of the pixels' gains, as a twin
            of noisy ones; labels such as signal-to-noise are those of the noisy sensor.
        band_nm: middle of the near-infrared band that a filter passes to a monochrome sensor, None for the visible; the
            responsivity is then that to sunlight through the filter, by the lux of all sunlight. [nm]
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
    optics: Optics = Optics()
    # Left out at its default, so that the hashes of other datasets stay those of earlier versions.
    noise_free: bool = Field(default=False, exclude_if=lambda noise_free: not noise_free)
    band_nm: float | None = Field(default=None, ge=750, le=1000, exclude_if=lambda band_nm: band_nm is None)

    @model_validator(mode="after")
    def _band_needs_a_monochrome_sensor(self) -> Self:
        if self.band_nm is not None and self.color != "mono":
            raise ValueError(f"band_nm: needs color = 'mono', got {self.color!r}")
        return self

    def electrons_per_cd_m2(self, exposure: Exposure) -> float:
        """Electrons of one pixel per luminance of the scene. [e- m2/cd]"""
        return self.responsivity_e_per_lux_s * exposure.lux_per_cd_m2 * exposure.time_s


class FrameSpec(FrozenModel):
    """Specification of one stereo pair. All of it is truth, which navigation never sees.

    Attributes:
        seed: with `frame_index` it keys every random stream; the recipe's `stream_seed`.
        frame_index: index in the dataset.
        family: the recipe's name for these conditions, for tables.
        scene_id: which drawn environment; splits are by scene.
        sequence_id: which sequence, or None for single frames.
        time_s: mid-exposure. [s]
        drogue: the drogue, or None for an empty frame.
        sought: in an empty frame of a dataset with several drogues, the one that navigation is to look for.
        condition: of the drogue's surfaces, or None when it is as new.
        bystanders: obstacles: the probe, bars close to the cameras, distractors.
        board: a calibration board instead of a drogue, or none.
        left_from_drogue: pose at mid-exposure, or None for an empty frame.
        world_from_left: world axes are x east, y north, z up; origin at the left eye.
        left_twist_per_s, drogue_twist_per_s: (6,) body twists over the exposure, each in its own frame, relative to
            axes that fly along with the tanker: velocity [m/s], then angular velocity [rad/s].
        tanker: what `left_from_tanker` is the pose of; None for a swept wing with one pod.
        left_from_tanker: pose of the tanker (x aft, y right wing, z up, origin where the hose leaves), or None.
        hose_nodes_left_m: (K, 3) centre line from coupling to pod in the left camera at mid-exposure, or None. [m]
        hose_look: paint of the hose, or None for the drogue's structural paint.
        neighbours: other drogues in view, none of which is sought.
        rig, sensor, exposure, environment: as named.
        camera: what the pictures go through besides the sensor, or None for nothing.
        rangefinder_reading_m: measured distance of the rim centre along the optical axis, or None without one. [m]
        loss: kind of the dropout whose onset, middle or end this frame is in, or None.
    """

    seed: int = Field(ge=0)
    frame_index: int = Field(ge=0)
    family: str = "clear"
    scene_id: int = Field(ge=0)
    sequence_id: int | None = Field(default=None, ge=0)
    time_s: float
    drogue: DrogueParameters | None
    sought: DrogueParameters | None = None
    condition: DrogueCondition | None = None
    bystanders: tuple[Obstacle, ...] = ()
    # Left out where there is none, so that the hashes of other datasets stay those of earlier versions.
    board: PlacedBoard | None = Field(default=None, exclude_if=lambda board: board is None)
    left_from_drogue: Transform | None
    world_from_left: Transform
    left_twist_per_s: Vector6
    drogue_twist_per_s: Vector6
    tanker: Tanker | None = Field(default=None, exclude_if=lambda tanker: tanker is None)
    left_from_tanker: Transform | None
    hose_nodes_left_m: Points3 | None
    hose_look: HoseLook | None = Field(default=None, exclude_if=lambda look: look is None)
    neighbours: tuple[OtherDrogue, ...] = Field(
        default=(), max_length=MAX_NEIGHBOURS, exclude_if=lambda neighbours: not neighbours
    )
    rig: Rig
    sensor: Sensor
    exposure: Exposure
    environment: Environment
    camera: VideoCamera | None = Field(default=None, exclude_if=lambda camera: camera is None)
    rangefinder_reading_m: float | None = Field(default=None, exclude_if=lambda reading_m: reading_m is None)
    loss: DropoutKind | None = Field(default=None, exclude_if=lambda loss: loss is None)

    @model_validator(mode="after")
    def _drogue_has_a_pose(self) -> Self:
        if (self.drogue is None) != (self.left_from_drogue is None):
            raise ValueError("left_from_drogue: must be given exactly when there is a drogue")
        if self.drogue is not None and self.board is not None:
            raise ValueError("board: stands only in frames without a drogue")
        if self.drogue is None and self.neighbours:
            raise ValueError("neighbours: are in view only beside the drogue that is sought")
        states = self.condition.markers if self.condition is not None else ()
        if self.condition is not None and self.drogue is None:
            raise ValueError("condition: an empty frame has none")
        if self.drogue is not None and states and len(states) != self.drogue.marker_count:
            raise ValueError(f"condition.markers: must be {self.drogue.marker_count} or none, got {len(states)}")
        return self

    @property
    def is_monochrome(self) -> bool:
        """Whether the sensor measures one band."""
        return self.sensor.color == "mono" or (self.camera is not None and self.camera.spectrum != "colour")

    @property
    def band_nm(self) -> float | None:
        """Middle of the band that a near-infrared camera or sensor measures; None for visible light. [nm]"""
        is_infrared = self.camera is not None and self.camera.spectrum == "near-infrared"
        return CAMERA_BAND_NM if is_infrared else self.sensor.band_nm

    def sought_and_neighbours(self) -> tuple[FrameSpec, ...]:
        """The frame as it is, then once for each neighbour with that as its drogue and no others."""
        frames = [self]
        for other in self.neighbours:
            changes = {
                "drogue": other.drogue,
                "condition": other.condition,
                "left_from_drogue": other.left_from_drogue,
                "hose_nodes_left_m": other.hose_nodes_left_m,
                "hose_look": other.hose_look,
                "left_from_tanker": other.left_from_tanker,
                "bystanders": (),
                "neighbours": (),
            }
            frames.append(self.model_copy(update=changes))
        return tuple(frames)

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

    def left_from_stage_at(self, offset_s: float) -> RigidTransform:
        """Pose of the axes in which everything that is drawn is at rest, `offset_s` after mid-exposure.

        These are the drogue's axes; without a drogue the left camera's own at mid-exposure, moving with the tanker.
        """
        if self.left_from_drogue is not None:
            return self.left_from_drogue_at(offset_s)
        moved: RigidTransform = exp_twist(-offset_s * self.left_twist_per_s)
        return moved

    def world_from_left_at(self, offset_s: float) -> RigidTransform:
        """Pose of the left camera in the world, `offset_s` after mid-exposure."""
        pose: RigidTransform = self.world_from_left @ exp_twist(offset_s * self.left_twist_per_s)
        return pose
