"""BOP: a stereo pair as two sensors of one image, models with their symmetries, everything in millimetres.

Source: the BOP challenge's description of its dataset format; sensors by suffix as in its industrial datasets. BOP's
boxes are differences of pixel numbers, one less than COCO's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from datasets_manifest.atomic import new_folder
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.image_codecs import encode_png, read_passes
from datasets_manifest.storage.layout import passes_file
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from drogue_models.drogue_families.body_symmetry import body_symmetry_order
from drogue_models.marker_layout import marker_layout
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import drogue_part_ids
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_twist
from geometry.stereo import EYES, Eye
from labelgen.export.export_log import ExportLog, require_pinholes
from labelgen.export.frame_files import export_image
from labelgen.part_pixels import parts_mask
from labelgen.segmentation_masks import Mask, amodal_masks, union_of_masks

MM_PER_M = 1000.0

SPLIT_FOLDERS: dict[SplitName, str] = {"train": "train_pbr", "val": "val", "test": "test"}

TARGETS_FILE = "test_targets_bop19.json"

# The challenge's targets are objects with at least this visible share.
_TARGET_FROM_FRACTION = 0.1

# Millimetres per depth number: the finest that holds the farthest thing in the image.
_DEPTH_SCALES = (0.1, 1.0, 10.0, 100.0)

_MAX_DEPTH_NUMBER = 65535

_INFO = """# {name}

A droguekit dataset in the BOP format. Lengths are millimetres.

* Sensors `left` and `right` are the eyes of one stereo rig; the image number is that of the pair.
* Camera axes are OpenCV's, pixel (0, 0) is the centre of the top-left one. World axes are x east, y north, z up, with
  the origin in the left eye.
* `train`, `val` and `test` of the dataset are `train_pbr`, `val` and `test`; `{targets}` lists the pairs of `test`
  in which at least a tenth of the drogue is seen by either eye.
* `mask` is all of the drogue as far as it is on the image, `mask_visib` what is seen of it: rim, face, canopy, ribs,
  coupling, hub and markers, without hose and tanker.
* `depth` is planar, 0 for the sky, in steps of the image's own `depth_scale`. {depth}
* Data licence: {licence}.
"""


def write_bop(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write a dataset for BOP's tools; arguments and errors as in `labelgen.export.formats`.

    Raises:
        ValueError: also for a rig with real lenses, whose images are no pinholes'.
    """
    source = Dataset(dataset)
    recipe = source.manifest.recipe
    require_pinholes(dataset, recipe.rig, "BOP")
    splits = source.manifest.split_of_frame()
    targets: list[dict[str, int]] = []
    with new_folder(out) as folder:
        _write_json(folder / "camera.json", _camera(recipe.rig.camera))
        for eye in EYES:
            _write_json(folder / f"camera_{eye}.json", _camera(recipe.rig.camera))
        write_models(recipe, folder)
        writer = _Scenes(source, folder, log)
        for record in log.records(source):
            log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
            split = splits[record.frame_index]
            seen = writer.add(record, split)
            if split == "test" and seen >= _TARGET_FROM_FRACTION:
                targets.append(
                    {
                        "im_id": record.frame_index,
                        "inst_count": 1,
                        "obj_id": object_id(recipe, record),
                        "scene_id": record.scene_id,
                    }
                )
        writer.finish()
        (folder / TARGETS_FILE).write_text(
            "[" + ",\n".join(map(canonical_json, sorted(targets, key=lambda target: target["scene_id"]))) + "]\n"
        )
        (folder / "dataset_info.md").write_text(
            _INFO.format(
                name=recipe.name,
                targets=TARGETS_FILE,
                depth="" if recipe.outputs.exr else "There is none: the dataset has no EXR files.",
                licence=source.manifest.data_licence,
            )
        )
    return [out]


class _Scenes:
    """The images and tables of all scenes, to which pairs are appended one by one."""

    def __init__(self, source: Dataset, folder: Path, log: ExportLog) -> None:
        self._source, self._folder, self._log = source, folder, log
        self._tables: set[Path] = set()

    def add(self, record: PairRecord, split: SplitName) -> float:
        """Write one pair.

        Returns:
            The visible share of the drogue, in the eye that sees more of it.
        """
        scene = self._folder / SPLIT_FOLDERS[split] / f"{record.scene_id:06d}"
        seen = [self._add_eye(record, eye, scene) for eye in EYES]
        return max(seen)

    def finish(self) -> None:
        """Close every table."""
        for path in sorted(self._tables):
            with path.open("a", encoding="utf-8") as stream:
                stream.write("\n}\n")

    def _add_eye(self, record: PairRecord, eye: Eye, scene: Path) -> float:
        index = record.frame_index
        picture = "gray" if record.frame.sensor.color == "mono" else "rgb"
        export_image(self._source, index, eye, scene / f"{picture}_{eye}" / f"{index:06d}.png", self._log)
        depth_scale = self._add_depth(record, eye, scene)
        self._append(scene / f"scene_camera_{eye}.json", index, _scene_camera(record, eye, depth_scale))
        truth, info, visible_share = [], [], 0.0
        if record.left_from_drogue is not None and record.frame.drogue is not None:
            masks = self._masks(record, eye)
            truth.append(_ground_truth(record, eye, object_id(self._source.manifest.recipe, record)))
            info.append(_info(record, eye, *masks))
            visible_share = info[0]["visib_fract"]
            for name, mask in zip(("mask", "mask_visib"), masks, strict=True):
                path = scene / f"{name}_{eye}" / f"{index:06d}_000000.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(encode_png(mask.astype(np.uint8) * np.uint8(255), is_piecewise_constant=True))
        self._append(scene / f"scene_gt_{eye}.json", index, truth)
        self._append(scene / f"scene_gt_info_{eye}.json", index, info)
        return visible_share

    def _masks(self, record: PairRecord, eye: Eye) -> tuple[Mask, Mask]:
        """Amodal and visible mask of the drogue."""
        assert record.frame.drogue is not None
        part_id = self._source.part_ids(record.frame_index, eye)
        parts = tuple(drogue_part_ids(record.frame.drogue.marker_count))
        return union_of_masks(amodal_masks(record, eye, part_id), parts, part_id.shape), parts_mask(part_id, parts)

    def _add_depth(self, record: PairRecord, eye: Eye, scene: Path) -> float:
        """Write the depth, where the dataset has it, and return millimetres per depth number."""
        if not self._source.manifest.recipe.outputs.exr:
            self._log.lost("depth images left out, for the dataset has no EXR files")
            return 1.0
        name = passes_file(eye)
        data = self._source.frames.read(record.frame_index, name)
        passes = read_passes(data, f"frame {record.frame_index}: {name}", record.frame.rig.camera)
        numbers, scale = depth_numbers(passes["depth.Z"])
        path = scene / f"depth_{eye}" / f"{record.frame_index:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(numbers, is_piecewise_constant=True))
        return scale

    def _append(self, path: Path, index: int, value: Any) -> None:
        begun = path in self._tables
        self._tables.add(path)
        with path.open("a", encoding="utf-8", newline="\n") as stream:
            stream.write(f'{"," if begun else "{"}\n"{index}": {canonical_json(value)}')


def depth_numbers(depth_m: NDArray[np.float32]) -> tuple[NDArray[np.uint16], float]:
    """(H, W) depth as BOP stores it, 0 for the sky and beyond the range, and millimetres per depth number."""
    known = np.isfinite(depth_m)
    depth_mm = np.where(known, depth_m, 0.0).astype(np.float64) * MM_PER_M
    farthest = float(depth_mm.max(initial=0.0))
    scale = next((scale for scale in _DEPTH_SCALES if farthest / scale <= _MAX_DEPTH_NUMBER), _DEPTH_SCALES[-1])
    numbers = np.rint(depth_mm / scale)
    return np.where(numbers <= _MAX_DEPTH_NUMBER, numbers, 0).astype(np.uint16), scale


def _write_json(path: Path, value: Any) -> None:
    path.write_text(canonical_json(value) + "\n", encoding="utf-8")


def _camera(camera: PinholeCamera) -> dict[str, float]:
    return {
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
        "width": camera.width_px,
        "height": camera.height_px,
        "depth_scale": 1.0,
    }


def _eye_from_left(record: PairRecord, eye: Eye) -> RigidTransform:
    return exp_twist(np.concatenate([-record.frame.rig.eye_offset_m(eye), np.zeros(3)]))


def _scene_camera(record: PairRecord, eye: Eye, depth_scale: float) -> dict[str, Any]:
    eye_from_world = _eye_from_left(record, eye) @ record.frame.world_from_left.inverse()
    return {
        "cam_K": record.frame.rig.camera.matrix().ravel().tolist(),
        "depth_scale": depth_scale,
        "cam_R_w2c": eye_from_world.rotation.ravel().tolist(),
        "cam_t_w2c": (eye_from_world.translation_m * MM_PER_M).tolist(),
    }


def _ground_truth(record: PairRecord, eye: Eye, obj_id: int) -> dict[str, Any]:
    assert record.left_from_drogue is not None
    eye_from_drogue = _eye_from_left(record, eye) @ record.left_from_drogue
    return {
        "cam_R_m2c": eye_from_drogue.rotation.ravel().tolist(),
        "cam_t_m2c": (eye_from_drogue.translation_m * MM_PER_M).tolist(),
        "obj_id": obj_id,
    }


def _count_all(record: PairRecord, eye: Eye, whole: Mask) -> int:
    """Pixels of the whole silhouette, also beyond the image, on a canvas of three times its size as in BOP."""
    view = record.views.left if eye == "left" else record.views.right
    if not view.truncated or record.frame.drogue is None:
        return int(np.count_nonzero(whole))
    rig = record.frame.rig
    c = rig.camera
    wide = PinholeCamera(3 * c.width_px, 3 * c.height_px, c.fx_px, c.fy_px, c.cx_px + c.width_px, c.cy_px + c.height_px)
    frame = record.frame.model_copy(update={"rig": replace(rig, camera=wide)})
    nothing = np.zeros((wide.height_px, wide.width_px), np.uint8)
    masks = amodal_masks(record.model_copy(update={"frame": frame}), eye, nothing)
    parts = tuple(drogue_part_ids(record.frame.drogue.marker_count))
    return int(np.count_nonzero(union_of_masks(masks, parts, nothing.shape)))


def _info(record: PairRecord, eye: Eye, whole: Mask, visible: Mask) -> dict[str, Any]:
    view = record.views.left if eye == "left" else record.views.right
    count_all, count_visible = _count_all(record, eye, whole), int(np.count_nonzero(visible))
    full = view.box_full_xywh_px
    if view.truncated and full is not None:
        low, high = np.ceil(full[:2]), np.floor(np.add(full[:2], full[2:]))
        box = [int(value) for value in (*low, *(high - low))]
    else:
        box = _box(whole)
    return {
        "bbox_obj": box,
        "bbox_visib": _box(visible),
        "px_count_all": count_all,
        "px_count_valid": int(np.count_nonzero(whole)),
        "px_count_visib": count_visible,
        "visib_fract": count_visible / count_all if count_all else 0.0,
    }


def _box(mask: Mask) -> list[int]:
    """x, y, width and height as BOP counts them; -1 all for an empty mask."""
    if not mask.any():
        return [-1, -1, -1, -1]
    column, row, width, height = cv2.boundingRect(mask.view(np.uint8))
    return [column, row, width - 1, height - 1]


def object_id(recipe: Recipe, record: PairRecord) -> int:
    """The object id of a pair's drogue: its place among the recipe's, from 1.

    Raises:
        ValueError: the pair has none, or one that is not in the recipe.
    """
    if record.frame.drogue not in recipe.drogues:
        raise ValueError(f"frame {record.frame_index}: drogue: is not in the recipe")
    return recipe.drogues.index(record.frame.drogue) + 1


def write_models(recipe: Recipe, folder: Path) -> None:
    """Write `models` and `models_eval`, which are the same.

    Raises:
        ValueError: a user's body mesh that is missing or was changed.
    """
    info = {}
    for name in ("models", "models_eval"):
        (folder / name).mkdir()
    for number, drogue in enumerate(recipe.drogues, start=1):
        mesh = trimesh.util.concatenate(list(drogue_meshes(drogue).values()))
        mesh.apply_scale(MM_PER_M)
        ply = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply")
        for name in ("models", "models_eval"):
            (folder / name / f"obj_{number:06d}.ply").write_bytes(ply)
        info[str(number)] = model_info(drogue, np.asarray(mesh.vertices, dtype=np.float64))
    for name in ("models", "models_eval"):
        (folder / name / "models_info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")


def model_info(drogue: DrogueParameters, vertices_mm: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, Any]:
    """Diameter, extent and symmetries of a model, from its (V, 3) vertices. [mm]

    The symmetries are those of the markers, or of the body of a drogue without any: turns about the axis as 4x4
    matrices, row by row, without the identity, or the axis about which every turn is one.

    Raises:
        ValueError: a user's body mesh that is missing or was changed.
    """
    low, size = vertices_mm.min(axis=0), np.ptp(vertices_mm, axis=0)
    hull = vertices_mm[ConvexHull(vertices_mm).vertices]
    order = marker_layout(drogue).symmetry_order if drogue.marker_count else body_symmetry_order(drogue)
    info: dict[str, Any] = {"diameter": float(pdist(hull).max())}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    if order == 0:
        info["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    elif order > 1:
        info["symmetries_discrete"] = [_turn(2 * np.pi * index / order) for index in range(1, order)]
    return info


def _turn(angle: float) -> list[float]:
    cosine, sine = float(np.cos(angle)), float(np.sin(angle))
    return [cosine, -sine, 0.0, 0.0, sine, cosine, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
