"""From a recipe and a frame index to a complete frame: any frame alone, in any order, on any machine."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.recipe import Family, Recipe
from datasets_manifest.recipe.rigs import ExposureLaw, Rangefinder
from datasets_manifest.types.appearance import PlacedBoard
from datasets_manifest.types.environment import Environment
from datasets_manifest.types.frame import Exposure, FrameSpec, Sensor
from datasets_manifest.types.video_camera import CAMERA_BAND_NM
from drogue_models.parameters import WHITE_PAINT, DrogueParameters
from drogue_models.surface_looks import HoseLook
from drogue_models.tankers.tanker import Tanker
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from scenes.camera_sampling import camera_of_scene
from scenes.drogue_appearance import blinking_condition, condition_of_scene, drogue_of_scene
from scenes.environment_radiance import EnvironmentRadiance, environment_radiance
from scenes.environment_sampling import environment_of_scene
from scenes.flight.sequence import sequence_kinematics, sequence_left_from_drogue
from scenes.flight.suspension import hang_hose, hose_look_of_scene, hose_of_scene, sample_suspension
from scenes.flight.trajectory import FrameKinematics, sample_attitude
from scenes.framing import outline_points_m, sample_distance_m, sample_pose
from scenes.sky.photometry import Radiance, light_in_band
from scenes.surroundings.bystander_sampling import bystanders_of_frame
from scenes.surroundings.neighbour_sampling import NeighbourKind, neighbours_of_frame
from scenes.tanker_sampling import hang_line, tanker_at, tanker_of_scene

SplitName = Literal["train", "val", "test"]
SPLITS: tuple[SplitName, ...] = ("train", "val", "test")
FRAME_PERIOD_S = 0.04  # 25 pairs per second
# Grid of directions at which the exposure meter looks.
_METER_COLUMNS, _METER_ROWS = 16, 12
# Of a view that is metered by its highlights, this share may be white.
_WHITE_SHARE = 0.1
_DARKEST_CD_M2 = 1e-9  # a millionth of a starlit sky; the limits of time and gain are reached long before


def scene_of_frame(recipe: Recipe, frame_index: int) -> int:
    """The scene of a frame: every run of as many frames as there are scenes visits each scene once.

    All frames of a sequence belong to one scene; every run of as many sequences as there are scenes visits each once.
    The order is drawn for each run, unless the recipe takes scenes in turn.
    """
    scenes, unit = recipe.frames.scenes, frame_index
    if recipe.sequence is not None:
        unit = frame_index // recipe.sequence.frames_per_sequence
    if recipe.frames.in_turn:
        return unit % scenes
    order = frame_generator(recipe.stream_seed, unit // scenes, "scene order").permutation(scenes)
    return int(order[unit % scenes])


def family_of_scene(recipe: Recipe, scene_id: int) -> Family | None:
    """The family of a scene, or None in a recipe without families.

    Every family gets its share of the scenes, rounded by largest remainders. Which scenes is drawn, unless families
    are taken in turn.
    """
    if not recipe.families:
        return None
    if recipe.frames.in_turn:
        return recipe.families[scene_id % len(recipe.families)]
    scenes = recipe.frames.scenes
    place = int(np.flatnonzero(frame_generator(recipe.stream_seed, 0, "families").permutation(scenes) == scene_id)[0])
    ends = np.cumsum(scenes_per_family(recipe))
    return recipe.families[int(np.searchsorted(ends, place, side="right"))]


def scenes_per_family(recipe: Recipe) -> list[int]:
    """Number of scenes of each family."""
    scenes = recipe.frames.scenes
    weights = np.array([family.weight for family in recipe.families])
    shares = weights / weights.sum() * scenes
    counts = np.floor(shares).astype(int)
    largest_first = np.argsort(-(shares - counts), kind="stable")
    counts[largest_first[: scenes - int(counts.sum())]] += 1
    return [int(count) for count in counts]


def recipe_of_scene(recipe: Recipe, scene_id: int) -> Recipe:
    """The recipe for one scene: with the name and the ranges of its family."""
    family = family_of_scene(recipe, scene_id)
    if family is None:
        return recipe
    changes = {
        "family": family.name,
        "pose": family.pose,
        "target": family.target,
        "environment": family.environment,
        "exposure": family.exposure,
        "tanker": family.tanker,
        "hose": family.hose,
        "receiver": family.receiver,
        "neighbours": family.neighbours,
        "camera": family.camera,
    }
    return recipe.model_copy(update=changes)


def split_of_scenes(recipe: Recipe) -> dict[int, SplitName]:
    """The split of every scene: shares of the scenes in a drawn order, rounded to whole scenes."""
    scenes = recipe.frames.scenes
    order = frame_generator(recipe.stream_seed, 0, "split").permutation(scenes).tolist()
    train_end = round(recipe.split.train * scenes)
    val_end = round((recipe.split.train + recipe.split.val) * scenes)
    return {
        scene_id: "train" if place < train_end else "val" if place < val_end else "test"
        for place, scene_id in enumerate(order)
    }


def sample_frame(recipe: Recipe, frame_index: int) -> FrameSpec:
    """Everything about one frame.

    Args:
        recipe: of the dataset.
        frame_index: in [0, count).

    Raises:
        ValueError: an index outside the recipe, or no pose keeps the drogue in view.
    """
    if not 0 <= frame_index < recipe.frames.count:
        raise ValueError(f"frame: must be in [0, {recipe.frames.count}), got {frame_index}")
    seed = recipe.stream_seed
    scene_id = scene_of_frame(recipe, frame_index)
    scene_recipe = recipe_of_scene(recipe, scene_id)
    environment = environment_of_scene(seed, scene_id, scene_recipe.environment)
    drogue = drogue_of_scene(scene_recipe, scene_id)
    tanker = tanker_of_scene(scene_recipe, scene_id)
    kinematics = _frame_kinematics(scene_recipe, drogue, tanker, scene_id, frame_index)
    pose = kinematics.left_from_drogue
    if kinematics.sequence_id is not None:
        environment = _environment_of_sequence(environment, kinematics)
    rig = scene_recipe.rig
    sensor, camera = camera_of_scene(scene_recipe, scene_id)
    is_infrared = camera is not None and camera.spectrum == "near-infrared"
    metered = sensor.model_copy(update={"band_nm": CAMERA_BAND_NM}) if is_infrared else sensor
    exposure = automatic_exposure(scene_recipe.exposure, environment, rig.camera, kinematics.world_from_left, metered)
    condition = None if pose is None else condition_of_scene(scene_recipe, scene_id, drogue)
    if pose is not None:
        condition = blinking_condition(condition, drogue, kinematics.time_s, exposure.time_s)
    neighbours = neighbours_of_frame(
        scene_recipe, scene_id, frame_index, kinematics, NeighbourKind(drogue, condition, tanker)
    )
    return FrameSpec(
        seed=seed,
        frame_index=frame_index,
        scene_id=scene_id,
        family=scene_recipe.family,
        sequence_id=kinematics.sequence_id,
        time_s=kinematics.time_s,
        drogue=None if pose is None else drogue,
        sought=drogue if pose is None and scene_recipe.target.variants else None,
        condition=condition,
        bystanders=bystanders_of_frame(scene_recipe, scene_id, frame_index, kinematics, tanker),
        board=_placed_board(scene_recipe, frame_index),
        left_from_drogue=pose,
        world_from_left=kinematics.world_from_left,
        left_twist_per_s=kinematics.left_twist_per_s,
        drogue_twist_per_s=kinematics.drogue_twist_per_s,
        tanker=None if pose is None else tanker_at(tanker, kinematics.time_s, exposure.time_s),
        left_from_tanker=kinematics.left_from_tanker,
        hose_nodes_left_m=kinematics.hose_nodes_left_m,
        hose_look=_hose_look(scene_recipe, scene_id, pose),
        neighbours=neighbours,
        rig=rig,
        sensor=sensor,
        exposure=exposure,
        environment=environment,
        camera=camera,
        rangefinder_reading_m=_rangefinder_reading_m(scene_recipe, frame_index, pose),
        loss=kinematics.loss,
    )


def _environment_of_sequence(environment: Environment, kinematics: FrameKinematics) -> Environment:
    """A scene's environment at the camera's position in a sequence, with the sun where a glare needs it."""
    changes: dict[str, object] = {"camera_offset_m": kinematics.camera_offset_m}
    if kinematics.sun_deg is not None:
        changes |= {"sun_elevation_deg": kinematics.sun_deg[0], "sun_azimuth_deg": kinematics.sun_deg[1]}
    return environment.model_copy(update=changes)


def sample_left_from_drogue(recipe: Recipe, frame_index: int) -> RigidTransform | None:
    """The pose of `sample_frame` alone, without light and exposure; None without a drogue.

    Raises:
        ValueError: no pose keeps the drogue in view.
    """
    scene_id = scene_of_frame(recipe, frame_index)
    scene_recipe = recipe_of_scene(recipe, scene_id)
    return left_from_drogue_in_scene(scene_recipe, drogue_of_scene(scene_recipe, scene_id), frame_index)


def left_from_drogue_in_scene(
    scene_recipe: Recipe, drogue: DrogueParameters, frame_index: int
) -> RigidTransform | None:
    """`sample_left_from_drogue` where the recipe of the frame's scene and its drogue are known already."""
    if scene_recipe.sequence is not None:
        return sequence_left_from_drogue(scene_recipe, scene_recipe.sequence, drogue, frame_index)
    return _pose_of_frame(scene_recipe, drogue, frame_index)


def _hose_look(scene_recipe: Recipe, scene_id: int, pose: RigidTransform | None) -> HoseLook | None:
    """Paint of the hose, or None without a drogue or in a recipe without `[hose]`."""
    if scene_recipe.hose is None or pose is None:
        return None
    return hose_look_of_scene(scene_recipe.stream_seed, scene_id, scene_recipe.hose)


def _frame_kinematics(
    scene_recipe: Recipe, drogue: DrogueParameters, tanker: Tanker | None, scene_id: int, frame_index: int
) -> FrameKinematics:
    """Poses and motion of one frame."""
    if scene_recipe.sequence is not None:
        return sequence_kinematics(scene_recipe, scene_recipe.sequence, drogue, frame_index)
    seed = scene_recipe.stream_seed
    rotation = sample_attitude(frame_generator(seed, frame_index, "receiver"), scene_recipe.pose)
    world_from_left = RigidTransform(rotation, np.zeros(3))
    left_from_drogue = _pose_of_frame(scene_recipe, drogue, frame_index)
    left_from_tanker, nodes = None, None
    if left_from_drogue is not None and tanker is not None and tanker.type == "multirotor":
        assert scene_recipe.tanker is not None
        left_from_tanker, nodes = hang_line(
            frame_generator(seed, frame_index, "line"), scene_recipe.tanker, drogue, left_from_drogue, world_from_left
        )
    elif left_from_drogue is not None:
        rng, ranges = frame_generator(seed, frame_index, "suspension"), scene_recipe.hose
        if ranges is None:
            left_from_tanker, nodes = sample_suspension(rng, drogue, left_from_drogue, world_from_left)
        else:
            hose = hose_of_scene(seed, scene_id, ranges, drogue)
            left_from_tanker, nodes = hang_hose(rng, ranges, hose, drogue, left_from_drogue, world_from_left)
    left_twist, drogue_twist = _sample_twists(frame_generator(seed, frame_index, "motion"), scene_recipe)
    return FrameKinematics(
        sequence_id=None,
        time_s=frame_index * FRAME_PERIOD_S,
        left_from_drogue=left_from_drogue,
        world_from_left=world_from_left,
        left_from_tanker=left_from_tanker,
        left_twist_per_s=left_twist,
        drogue_twist_per_s=drogue_twist,
        hose_nodes_left_m=nodes,
    )


def _pose_of_frame(scene_recipe: Recipe, drogue: DrogueParameters, frame_index: int) -> RigidTransform | None:
    """`left_from_drogue`, or None without a drogue."""
    if frame_generator(scene_recipe.stream_seed, frame_index, "empty").random() < scene_recipe.frames.empty_fraction:
        return None
    distance_m = sample_distance_m(
        frame_generator(scene_recipe.stream_seed, frame_index, "distance"), scene_recipe.distance, frame_index
    )
    return sample_pose(
        frame_generator(scene_recipe.stream_seed, frame_index, "pose"),
        scene_recipe,
        outline_points_m(drogue),
        distance_m,
    )


def _placed_board(scene_recipe: Recipe, frame_index: int) -> PlacedBoard | None:
    """The calibration board of a frame, or None without one."""
    if scene_recipe.board is None:
        return None
    distance_m = sample_distance_m(
        frame_generator(scene_recipe.stream_seed, frame_index, "distance"), scene_recipe.distance, frame_index
    )
    pose = sample_pose(
        frame_generator(scene_recipe.stream_seed, frame_index, "pose"),
        scene_recipe,
        scene_recipe.board.outline_m(),
        distance_m,
        shows_front=True,
    )
    return PlacedBoard(shape=scene_recipe.board, left_from_board=pose)


def _rangefinder_reading_m(
    scene_recipe: Recipe, frame_index: int, left_from_drogue: RigidTransform | None
) -> float | None:
    """Reading of the rangefinder, or None without one or without a drogue."""
    if scene_recipe.rangefinder is None or left_from_drogue is None:
        return None
    return sample_rangefinder_m(
        scene_recipe.rangefinder, scene_recipe.stream_seed, frame_index, float(left_from_drogue.translation_m[2])
    )


def sample_rangefinder_m(rangefinder: Rangefinder, seed: int, frame_index: int, distance_m: float) -> float:
    """Reading of a laser rangefinder: the same offset in all frames of a dataset, and noise of each frame. [m]"""
    offset_m = frame_generator(seed, 0, "rangefinder offset").uniform(-1.0, 1.0) * rangefinder.offset_m
    noise_m = frame_generator(seed, frame_index, "rangefinder noise").standard_normal() * rangefinder.noise_m
    reading_m, step_m = distance_m + offset_m + noise_m, rangefinder.resolution_m
    # Rounded to decimal digits, because float64 cannot represent multiples of most steps.
    return float(np.round(step_m * np.rint(reading_m / step_m), 12)) if step_m > 0 else float(reading_m)


def _sample_twists(rng: np.random.Generator, scene_recipe: Recipe) -> tuple[Array, Array]:
    """(6,) twists of the left camera and of the drogue. [m/s, rad/s]"""
    draws = rng.uniform(-1.0, 1.0, 12)
    rate = np.radians(scene_recipe.pose.rate_deg_s)
    left = np.concatenate([np.zeros(3), draws[3:6] * rate])
    drogue = np.concatenate([draws[6:9] * scene_recipe.pose.speed_m_s, draws[9:12] * rate])
    return left, drogue


def automatic_exposure(
    law: ExposureLaw, environment: Environment, camera: PinholeCamera, world_from_left: RigidTransform, sensor: Sensor
) -> Exposure:
    """Exposure that brings the light that the law meters, see `ExposureLaw`, to the law's level.

    That is luminance, or behind an infrared filter the light in its band. A longer time comes first, because it
    collects more light; gain only makes up for what the limits of time leave.
    """
    gain = law.auto_gain
    if law.time_s is not None and gain.low == gain.high:
        return Exposure(time_s=law.time_s, f_number=law.f_number, gain=gain.low)
    ambient = environment_radiance(environment)
    plate = ambient.plate_illuminance_lux(-world_from_left.rotation[:, 2]) * np.array(WHITE_PAINT) / np.pi
    brightest = max(float(light_in_band(plate, sensor.band_nm)), _DARKEST_CD_M2)
    if law.auto_meter == "view":
        view = _view(ambient, camera, world_from_left)
        brightest = max(brightest, float(light_in_band(view, sensor.band_nm).mean()))
    elif law.auto_meter == "highlights":
        pixels = light_in_band(_pixels(ambient, camera, world_from_left), sensor.band_nm)
        white = law.auto_level_fraction * float(np.quantile(pixels, 1.0 - _WHITE_SHARE))
        brightest = max(brightest, float(pixels.mean()), white)
    one_second = Exposure(time_s=1.0, f_number=law.f_number)
    wanted_s = law.auto_level_fraction * sensor.full_well_e / (sensor.electrons_per_cd_m2(one_second) * brightest)
    time_s = law.time_s
    if time_s is None:
        # A site holds no more than its full well, however low the gain.
        time_s = float(np.clip(wanted_s / max(1.0, gain.low), law.auto_time_s.low, law.auto_time_s.high))
    gain_used = float(np.clip(wanted_s / time_s, gain.low, gain.high))
    return Exposure(time_s=time_s, f_number=law.f_number, gain=gain_used)


def _view(ambient: EnvironmentRadiance, camera: PinholeCamera, world_from_left: RigidTransform) -> Radiance:
    """(H, W, 3) coarse picture of the camera's view without a drogue. [cd/m2]"""
    return ambient.radiance(_directions(camera, world_from_left, *_meter_grid(camera, _METER_COLUMNS, _METER_ROWS)))


def _pixels(ambient: EnvironmentRadiance, camera: PinholeCamera, world_from_left: RigidTransform) -> Radiance:
    """(1, 2 N, 3) light of pixels all over the camera's view without a drogue, in pairs of neighbours. [cd/m2]

    What a ray sees is averaged up to its neighbour in the array: rays far apart see less of bright clouds.
    """
    # An odd number of pairs: the middle, whose neighbour decides, is the second of a pair.
    u, v = (grid.ravel() for grid in _meter_grid(camera, _METER_COLUMNS + 1, _METER_ROWS + 1))
    u, v = np.stack([u, u + 1.0], axis=-1).reshape(1, -1), np.repeat(v, 2)[None]
    return ambient.radiance(_directions(camera, world_from_left, u, v))


def _meter_grid(camera: PinholeCamera, columns: int, rows: int) -> tuple[Array, Array]:
    """Two (rows, columns) coordinates of evenly spaced places in the picture. [px]"""
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) * camera.width_px / columns, (np.arange(rows) + 0.5) * camera.height_px / rows
    )
    return u, v


def _directions(
    camera: PinholeCamera, world_from_left: RigidTransform, u_px: Array, v_px: Array
) -> NDArray[np.float32]:
    """(..., 3) unit vectors in world axes through places in the left picture."""
    rays = world_from_left.rotate(camera.rays(np.stack([u_px, v_px], axis=-1)))
    directions: NDArray[np.float32] = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return directions
