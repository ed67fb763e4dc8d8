"""Small frames with random pictures: what lies on disk, without rendering or labels."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.writer import encode_files, write_frame
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import Conditions, PairRecord, StereoViews, ViewRecord
from geometry.se3 import RigidTransform, exp_twist
from tests.support.recipe_builder import between, build_recipe


def make_recipe(preset: str = "rgb-ideal", bits: int = 8) -> Recipe:
    return build_recipe(
        name="tiny",
        seed=0,
        rig={"preset": preset, "width_px": 48, "height_px": 36, "focal_px": 80.0, "output_bits": bits},
        frames={"count": 4, "scenes": 2},
        distance=between(2.0, 3.0),
    )


def make_images(recipe: Recipe, frame_index: int) -> StereoImages:
    """Random numbers over the whole range of the sensor."""
    rng = np.random.default_rng(frame_index)
    sensor, camera = recipe.sensor, recipe.rig.camera
    dtype = np.uint8 if sensor.output_bits == 8 else np.uint16
    gray = (camera.height_px, camera.width_px)
    shape = gray if sensor.color == "mono" else (*gray, 3)
    left, right = rng.integers(0, 2**sensor.output_bits, (2, *shape), dtype=dtype)
    mosaics = (None, None)
    if sensor.color == "bayer":
        mosaics = tuple(rng.integers(0, 2**sensor.output_bits, (2, *gray), dtype=dtype))
    return StereoImages(left, right, 0.04 * frame_index, 1e-3, sensor.output_bits, "linear", 4.0, *mosaics)


def make_parts(recipe: Recipe, frame_index: int) -> dict:
    rng = np.random.default_rng(frame_index + 1000)
    shape = (recipe.rig.camera.height_px, recipe.rig.camera.width_px)
    return {eye: rng.integers(0, 40, shape, dtype=np.uint8) for eye in ("left", "right")}


def make_record(recipe: Recipe, frame_index: int, empty: bool = False) -> PairRecord:
    pose = None if empty else exp_twist([0.1, 0.2, 2.5, 0.1, -0.05, 0.3 + frame_index])
    frame = FrameSpec(
        seed=recipe.seed,
        frame_index=frame_index,
        scene_id=frame_index % 2,
        time_s=0.04 * frame_index,
        drogue=None if empty else recipe.drogue,
        left_from_drogue=pose,
        world_from_left=RigidTransform.identity(),
        left_twist_per_s=np.zeros(6),
        drogue_twist_per_s=np.zeros(6),
        left_from_tanker=None,
        hose_nodes_left_m=None,
        rig=recipe.rig,
        sensor=recipe.sensor,
        exposure={"time_s": 1e-3, "f_number": 2.8},
        environment={
            "sun_elevation_deg": 30,
            "sun_azimuth_deg": 0,
            "turbidity": 3,
            "visibility_m": 30_000,
            "altitude_m": 3000,
            "ground_reflectance_rgb": (0.1, 0.1, 0.1),
            "ground_texture_seed": 0,
        },
    )
    view = ViewRecord(
        markers=(),
        hub=None,
        box_full_xywh_px=None,
        box_visible_xywh_px=None,
        visible_drogue_px=0,
        truncated=False,
    )
    return PairRecord(
        frame_index=frame_index,
        scene_id=frame.scene_id,
        sequence_id=None,
        time_s=frame.time_s,
        left_from_drogue=pose,
        left_from_drogue_open=pose,
        left_from_drogue_close=pose,
        pitch_deg=None if empty else 1 / 3,
        yaw_deg=None if empty else -0.1,
        roll_deg=None if empty else 1e-17,
        roll_modulo_deg=None if empty else 0.0,
        views=StereoViews(left=view, right=view),
        conditions=Conditions(
            family="clear",
            distance_m=None if empty else 2.5,
            sun_elevation_deg=30.0,
            background_luminance_cd_m2=3e3,
            monte_carlo_noise_fraction=0.01,
        ),
        engine="mitsuba",
        engine_version="mitsuba 3",
        image_black_level_dn=4.0,
        file_sha256={},
        frame=frame,
    )


def add_frame(dataset: Path, recipe: Recipe, frame_index: int, empty: bool = False) -> PairRecord:
    files = encode_files(make_images(recipe, frame_index), make_parts(recipe, frame_index))
    return write_frame(dataset, make_record(recipe, frame_index, empty), files)


SPLIT_OF_SCENE = {scene_id: ("train", "test")[scene_id % 2] for scene_id in range(4)}


@pytest.fixture
def maker() -> tuple[Callable[..., Any], ...]:
    """The functions above, for tests that choose sensor and frames."""
    return make_recipe, make_images, make_parts, make_record, add_frame


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A dataset of three pairs, the last one empty, in a folder of its own."""
    recipe, dataset = make_recipe(), tmp_path / "tiny"
    for frame_index in (0, 1, 3):
        add_frame(dataset, recipe, frame_index, empty=frame_index == 3)
    write_manifest(dataset, build_manifest(dataset, recipe, "1", SPLIT_OF_SCENE))
    return dataset


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 kB of its own."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("a disk can only be mounted by root")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)
