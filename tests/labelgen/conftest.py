"""Frames whose passes come from a plain z-buffer, written apart from the engines and from the labels."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.calibration import write_calibration
from datasets_manifest.frame import FrameSpec
from datasets_manifest.images import StereoImages
from datasets_manifest.manifest import build_manifest, write_manifest
from datasets_manifest.recipe import Recipe, parse_recipe
from datasets_manifest.records import PairRecord
from datasets_manifest.writer import encode_files, write_frame
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.stereo import Eye
from labelgen.export.coco import write_coco
from labelgen.frame_labels import label_frame
from render.engine import EyeRadiance, StereoRadiance
from render.sensor import expose
from scenes.sampler import sample_frame

RECIPE = """
name = "small"
seed = 3
[rig]
preset = "rgb-ideal"
width_px = 240
height_px = 180
focal_px = 400.0
[frames]
count = 6
scenes = 3
empty_fraction = 0.3
[distance]
law = "stations"
stations_m = [1.7, 2.5, 4.0]
[split]
train = 0.34
val = 0.33
test = 0.33
"""

# Luminance of each kind of part [cd/m2]: bright features, dark structure, a sky between.
SKY, FEATURE, STRUCTURE = 2000.0, 6000.0, 150.0


@lru_cache(maxsize=1)
def drogue_triangles(drogue: DrogueParameters) -> dict[int, np.ndarray]:
    """(T, 3, 3) corners of every part in the drogue frame."""
    return {part: np.asarray(mesh.triangles) for part, mesh in drogue_meshes(drogue).items()}


def facing_triangles(frame: FrameSpec, eye: Eye) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Part id, (3, 3) corners in the eye's frame and (3,) normal of every face that may show at a pixel centre."""
    assert frame.drogue is not None and frame.left_from_drogue is not None
    for part, triangles in drogue_triangles(frame.drogue).items():
        corners = frame.left_from_drogue.apply(triangles) - frame.rig.eye_offset_m(eye)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = (normals * corners[:, 0]).sum(axis=1) < 0
        image = frame.rig.camera.project(corners)
        facing &= (np.ceil(image.min(axis=1)) <= np.floor(image.max(axis=1))).all(axis=1)
        for triangle, normal in zip(corners[facing], normals[facing], strict=True):
            yield part, triangle, normal / np.linalg.norm(normal)


def draw_eye(frame: FrameSpec, eye: Eye) -> EyeRadiance:
    """One eye's passes by a z-buffer at pixel centres, each part evenly bright."""
    camera = frame.rig.camera
    shape = (camera.height_px, camera.width_px)
    ids, depth, normal = np.zeros(shape, np.uint8), np.full(shape, np.inf), np.zeros((*shape, 3))
    fronts: dict[int, np.ndarray] = {}
    for part, corners, face in [] if frame.drogue is None else facing_triangles(frame, eye):
        image = camera.project(corners)
        low = np.maximum(np.ceil(image.min(axis=0)), 0).astype(int)
        high = np.minimum(np.floor(image.max(axis=0)), (camera.width_px - 1, camera.height_px - 1)).astype(int)
        if (low > high).any():
            continue
        v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
        edges = [
            (b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])
            for a, b in zip(image, image[[1, 2, 0]], strict=True)
        ]
        inside = np.all([edge >= 0 for edge in edges], axis=0) | np.all([edge <= 0 for edge in edges], axis=0)
        z = (corners[0] @ face) / (camera.rays(np.stack([u, v], axis=-1)) @ face)
        window = (slice(low[1], high[1] + 1), slice(low[0], high[0] + 1))
        nearer = inside & (z < depth[window])
        depth[window][nearer], ids[window][nearer], normal[window][nearer] = z[nearer], part, face
        # What counts as the whole feature is its front face, which looks along the drogue's -z.
        if (part == Part.HUB or part >= FIRST_MARKER_ID) and face @ frame.left_from_drogue.rotation[:, 2] < -0.999:
            fronts.setdefault(part, np.zeros(shape, bool))[window] |= inside
    level = np.where(ids == Part.SKY, SKY, STRUCTURE)
    level = np.where((ids == Part.HUB) | (ids >= FIRST_MARKER_ID), FEATURE, level)
    return EyeRadiance(
        radiance_cd_m2=np.repeat(level[:, :, None], 3, axis=2).astype(np.float32),
        coverage=(ids != Part.SKY).astype(np.float32),
        part_id=ids,
        depth_m=depth.astype(np.float32),
        normal=normal.astype(np.float32),
        amodal_px={part: int(np.count_nonzero(front)) for part, front in fronts.items()},
    )


def draw_pair(frame: FrameSpec) -> StereoRadiance:
    """Both eyes of a frame."""
    return StereoRadiance(draw_eye(frame, "left"), draw_eye(frame, "right"), "z-buffer", "1", 0.0, {})


class Pair:
    """A frame with all that was made of it."""

    def __init__(self, frame: FrameSpec) -> None:
        self.frame = frame
        self.radiance = draw_pair(frame)
        self.images: StereoImages = expose(frame, self.radiance)
        self.record: PairRecord = label_frame(frame, self.radiance, self.images)


@pytest.fixture(scope="session")
def small_recipe() -> Recipe:
    return parse_recipe(RECIPE)


@pytest.fixture(scope="session")
def pairs(small_recipe: Recipe) -> list[Pair]:
    """All frames of the recipe: some near, some far, at least one without a drogue."""
    drawn = [Pair(sample_frame(small_recipe, index)) for index in range(small_recipe.frames.count)]
    assert any(pair.frame.drogue is None for pair in drawn)
    return drawn


@pytest.fixture(scope="session")
def full_pairs(pairs: list[Pair]) -> list[Pair]:
    """Those with a drogue."""
    return [pair for pair in pairs if pair.frame.drogue is not None]


def write_small_dataset(folder: Path, recipe: Recipe, pairs: list[Pair]) -> Path:
    """A complete dataset of these pairs."""
    for pair in pairs:
        parts = {"left": pair.radiance.left.part_id, "right": pair.radiance.right.part_id}
        write_frame(folder, pair.record, encode_files(pair.images, parts))
    splits = ("train", "val", "test")
    write_manifest(folder, build_manifest(folder, recipe, "1", lambda scene_id: splits[scene_id % 3]))
    write_calibration(folder, recipe.rig)
    write_coco(folder, folder / "annotations")
    return folder


@pytest.fixture
def small_dataset(tmp_path: Path, small_recipe: Recipe, pairs: list[Pair]) -> Path:
    """A dataset that a test may damage."""
    return write_small_dataset(tmp_path / "dataset", small_recipe, pairs)
