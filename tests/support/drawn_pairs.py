"""Frames whose passes come from a plain z-buffer, written apart from the engines and from the labels."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.writer import encode_files, write_calibration, write_frame
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.stereo import Eye
from labelgen.export.annotations.coco import write_annotations
from labelgen.frame_labels import label_frame
from render.camera.sensor import expose
from render.engine import EyeRadiance, StereoRadiance

# Luminance of each kind of part [cd/m2]: bright features, dark structure, a sky between.
SKY, FEATURE, STRUCTURE = 2000.0, 6000.0, 150.0


@lru_cache(maxsize=1)
def drogue_triangles(drogue: DrogueParameters) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3, 3) corners of all triangles in the drogue frame and (T,) part ids."""
    meshes = drogue_meshes(drogue)
    corners = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes.values()])
    parts = np.repeat(np.array(list(meshes), dtype=np.uint8), [len(mesh.faces) for mesh in meshes.values()])
    return corners, parts


def hits_of(frame: FrameSpec, eye: Eye) -> tuple[np.ndarray, ...]:
    """Every hit of a pixel centre's ray on a face that looks at the eye: flat pixel, depth, part id, unit normal."""
    assert frame.drogue is not None and frame.left_from_drogue is not None
    camera = frame.rig.camera
    corners, parts = drogue_triangles(frame.drogue)
    corners = frame.left_from_drogue.apply(corners) - frame.rig.eye_offset_m(eye)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    image = camera.project(corners)
    low = np.maximum(np.ceil(image.min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(image.max(axis=1)), (camera.width_px - 1, camera.height_px - 1)).astype(int)
    size = np.maximum(high - low + 1, 0)
    # Every pixel centre in every triangle's bounding box.
    count = size.prod(axis=1) * ((faces * corners[:, 0]).sum(axis=1) < 0)
    index = np.repeat(np.arange(len(count)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    pixel = low[index] + np.stack([place % size[index, 0], place // size[index, 0]], axis=-1)
    side = []
    for one, other in ((0, 1), (1, 2), (2, 0)):
        edge, reach = image[index, other] - image[index, one], pixel - image[index, one]
        side.append(edge[:, 0] * reach[:, 1] - edge[:, 1] * reach[:, 0])
    inside = (np.min(side, axis=0) >= 0) | (np.max(side, axis=0) <= 0)
    index, pixel = index[inside], pixel[inside]
    depth = (corners[index, 0] * faces[index]).sum(axis=1) / (camera.rays(pixel) * faces[index]).sum(axis=1)
    normals = faces[index] / np.linalg.norm(faces[index], axis=1, keepdims=True)
    return pixel[:, 1] * camera.width_px + pixel[:, 0], depth, parts[index], normals


def draw_eye(frame: FrameSpec, eye: Eye) -> EyeRadiance:
    """One eye's passes at pixel centres, each part evenly bright."""
    camera = frame.rig.camera
    shape = (camera.height_px, camera.width_px)
    ids, depth, normal = np.zeros(shape, np.uint8), np.full(shape, np.inf), np.zeros((*shape, 3))
    amodal = {}
    if frame.drogue is not None:
        pixels, depths, parts, normals = hits_of(frame, eye)
        order = np.lexsort((depths, pixels))
        _, first = np.unique(pixels[order], return_index=True)
        nearest = order[first]
        ids.flat[pixels[nearest]], depth.flat[pixels[nearest]] = parts[nearest], depths[nearest]
        normal.reshape(-1, 3)[pixels[nearest]] = normals[nearest]
        # What counts as the whole feature is its front face, which looks along the drogue's -z.
        front = normals @ frame.left_from_drogue.rotation[:, 2] < -0.999
        features = (int(Part.HUB), *(FIRST_MARKER_ID + index for index in range(frame.drogue.marker_count)))
        amodal = {part: len(np.unique(pixels[front & (parts == part)])) for part in features}
    level = np.where(ids == Part.SKY, SKY, STRUCTURE)
    level = np.where((ids == Part.HUB) | (ids >= FIRST_MARKER_ID), FEATURE, level)
    return EyeRadiance(
        radiance_cd_m2=np.repeat(level[:, :, None], 3, axis=2).astype(np.float32),
        coverage=(ids != Part.SKY).astype(np.float32),
        part_id=ids,
        depth_m=depth.astype(np.float32),
        normal=normal.astype(np.float32),
        amodal_px=amodal,
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


def write_drawn_dataset(folder: Path, recipe: Recipe, pairs: Iterable[Pair]) -> Path:
    """A complete dataset of these pairs."""
    for pair in pairs:
        parts = {"left": pair.radiance.left.part_id, "right": pair.radiance.right.part_id}
        write_frame(folder, pair.record, encode_files(pair.images, parts))
    splits = ("train", "val", "test")
    split_of_scene = {scene_id: splits[scene_id % 3] for scene_id in range(recipe.frames.scenes)}
    write_manifest(folder, build_manifest(folder, recipe, "1", split_of_scene))
    write_calibration(folder, recipe.rig)
    write_annotations(folder, folder / "annotations")
    return folder
