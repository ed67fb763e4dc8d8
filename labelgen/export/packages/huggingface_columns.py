"""The columns of a table for Hugging Face's `datasets`: their types, what they hold, and their values for a pair.

Points and boxes count from the image's corner, as in COCO: the centre of the top-left pixel is (0.5, 0.5).

Source: `Features` of Hugging Face's `datasets`, as its JSON (in the schema of Parquet files, key `huggingface`) and as
its YAML (in a card, `dataset_info`). Lists have the type `Sequence`, which all versions of the library read.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import image_file, mosaic_file, parts_file, passes_file
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from geometry.distortion import Lens
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.annotated_views import annotated_objects
from labelgen.export.annotations.coco import coco_feature_id, coco_image_id
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import display_png, full_range_png
from labelgen.export.keypoints import view_keypoints, view_of

Feature = dict[str, Any]
"""A type of `datasets` as its JSON, such as `{"dtype": "int64", "_type": "Value"}`; a mapping of names is a struct."""


def _value(dtype: str) -> Feature:
    return {"dtype": dtype, "_type": "Value"}


def _list(feature: Feature) -> Feature:
    return {"feature": feature, "_type": "Sequence"}


def _labels(*names: str) -> Feature:
    return {"names": list(names), "_type": "ClassLabel"}


INTEGER, NUMBER, TEXT = _value("int64"), _value("float64"), _value("string")
PICTURE: Feature = {"_type": "Image"}
# The Hub's viewer leaves columns of bytes out. It cannot show pictures of floating-point numbers and would stop there.
DATA = _value("binary")
POSE: Feature = {"translation_m": _list(NUMBER), "quaternion_xyzw": _list(NUMBER)}

CATEGORIES = ("drogue", "marker", "hub")
_OBJECTS: Feature = {
    "id": _list(INTEGER),
    "category": _list(_labels(*CATEGORIES)),
    "bbox": _list(_list(NUMBER)),
    "area": _list(INTEGER),
    "marker_index": _list(INTEGER),
    "visible_fraction": _list(NUMBER),
}
_KEYPOINTS: Feature = {
    "id": _list(INTEGER),
    "point": _list(_list(NUMBER)),
    # The numbers are COCO's.
    "visibility": _list(_labels("outside", "hidden", "visible")),
    "visible_fraction": _list(NUMBER),
}
_CAMERA: Feature = {"matrix": _list(_list(NUMBER)), "distortion": _list(NUMBER), "camera_from_left": POSE}
_CONDITIONS = ("sun_elevation_deg", "background_luminance_cd_m2")
_NOISES = ("monte_carlo_noise_fraction", "monte_carlo_over_sensor_noise")


@dataclass(frozen=True)
class HubColumn:
    """One column: its type, and what it holds, for the card."""

    feature: Feature
    meaning: str


def hub_columns(manifest: Manifest) -> dict[str, HubColumn]:
    """The columns of a dataset's table by name, in their order."""
    recipe = manifest.recipe
    columns = {
        "frame_index": HubColumn(INTEGER, "number of the pair"),
        "scene_id": HubColumn(INTEGER, "drawn environment; no two splits share one"),
        "sequence_id": HubColumn(INTEGER, "sequence, null for single pairs"),
        "split": HubColumn(TEXT, "`train`, `val` or `test`"),
        "time_s": HubColumn(NUMBER, "mid-exposure [s]"),
    }
    seen = "what the camera saw"
    columns |= _by_eye("image", PICTURE, f"{seen}, on the sRGB curve" if recipe.sensor.encoding == "linear" else seen)
    if recipe.sensor.color == "bayer":
        columns |= _by_eye("mosaic", PICTURE, "raw RGGB mosaic")
    columns |= _by_eye("parts", PICTURE, "part id of every pixel, listed below; null where the dataset has none")
    if recipe.outputs.exr:
        columns |= _by_eye("depth_m", DATA, "planar depth [m] as a float32 TIFF, infinite for the sky")
    columns |= {
        "distance_m": HubColumn(NUMBER, "Z of the rim's centre in the left camera [m]; null without a drogue"),
        "drogue": HubColumn(TEXT, "its name; null without a drogue"),
        "left_from_drogue": HubColumn(
            POSE,
            "pose of the drogue in the left camera at mid-exposure: translation [m], quaternion x, y, z, w; "
            "null without a drogue",
        ),
    }
    columns |= _by_eye(
        "objects", _OBJECTS, "lists of what is seen: `bbox` is x, y, width, height of the visible pixels [px]"
    )
    columns |= _by_eye(
        "keypoints", _KEYPOINTS, "lists of the markers in the drogue's order: `point` is the image of the centre [px]"
    )
    columns |= _by_eye(
        "camera", _CAMERA, "intrinsics for pixel centres at integers [px], OpenCV's distortion, pose beside the left"
    )
    conditions = {"family": TEXT, **dict.fromkeys((*_CONDITIONS, *_NOISES), NUMBER)}
    return {
        **columns,
        "conditions": HubColumn(conditions, "by which reports group pairs"),
        "exposure": HubColumn({"time_s": NUMBER, "f_number": NUMBER, "gain": NUMBER}, "of both eyes"),
        "image_black_level_dn": HubColumn(
            NUMBER, "pixel value of the images without light, in steps of the sensor's own bits"
        ),
        "record": HubColumn(TEXT, "the whole record as JSON"),
    }


def _by_eye(name: str, feature: Feature, meaning: str) -> dict[str, HubColumn]:
    return {f"{eye}_{name}": HubColumn(feature, meaning) for eye in EYES}


_ARROW_TYPES = {"int64": pa.int64(), "float64": pa.float64(), "string": pa.string(), "binary": pa.binary()}


def arrow_type(feature: Feature) -> pa.DataType:
    """How Arrow stores a type of `datasets`."""
    match feature.get("_type"):
        case "Value":
            return _ARROW_TYPES[feature["dtype"]]
        case "Image":
            return pa.struct({"bytes": pa.binary(), "path": pa.string()})
        case "ClassLabel":
            return pa.int64()
        case "Sequence":
            return pa.list_(arrow_type(feature["feature"]))
        case _:
            return pa.struct({name: arrow_type(part) for name, part in feature.items()})


def yaml_feature(feature: Feature) -> dict[str, Any]:
    """A type as a card's YAML writes it."""
    match feature.get("_type"):
        case "Value":
            return {"dtype": feature["dtype"]}
        case "Image":
            return {"dtype": "image"}
        case "ClassLabel":
            return {"dtype": {"class_label": {"names": {str(i): name for i, name in enumerate(feature["names"])}}}}
        case "Sequence":
            inner = yaml_feature(feature["feature"])
            return {"sequence": inner.get("dtype", inner)}
        case _:
            return {"struct": [{"name": name, **yaml_feature(part)} for name, part in feature.items()]}


def hub_row(source: Dataset, record: PairRecord, split: str, log: ExportLog) -> dict[str, Any]:
    """One pair, by column; the log counts what it has no column for.

    Raises:
        ValueError: an image, part ids or passes that cannot be read; names the file.
    """
    log.lost("drogues beside the sought one: left out of the objects", len(record.frame.neighbours))
    recipe, index = source.manifest.recipe, record.frame_index
    row: dict[str, Any] = {
        "frame_index": index,
        "scene_id": record.scene_id,
        "sequence_id": record.sequence_id,
        "split": split,
        "time_s": record.time_s,
        "distance_m": record.conditions.distance_m,
        "drogue": None if record.frame.drogue is None else record.frame.drogue.name,
        "left_from_drogue": None if record.left_from_drogue is None else _pose(record.left_from_drogue),
        "conditions": record.conditions.model_dump(include={"family", *_CONDITIONS, *_NOISES}),
        "exposure": record.frame.exposure.model_dump(include={"time_s", "f_number", "gain"}),
        "image_black_level_dn": 0.0 if recipe.sensor.encoding == "linear" else record.image_black_level_dn,
        "record": canonical_json(record.model_dump(mode="json")),
    }
    for eye in EYES:
        row[f"{eye}_image"] = _picture(_shown_png(source, index, image_file(eye)), index, image_file(eye))
        if recipe.sensor.color == "bayer":
            mosaic = full_range_png(source, index, mosaic_file(eye))
            row[f"{eye}_mosaic"] = _picture(mosaic, index, mosaic_file(eye))
        if parts_file(eye) in record.file_sha256:
            row[f"{eye}_parts"] = _picture(source.frames.read(index, parts_file(eye)), index, parts_file(eye))
        if recipe.outputs.exr:
            row[f"{eye}_depth_m"] = _depth_tiff(source, record, eye)
        row[f"{eye}_objects"] = _objects(source, record, eye, log)
        row[f"{eye}_keypoints"] = _keypoints(record, eye)
        row[f"{eye}_camera"] = _camera(record, eye)
    return row


def _shown_png(source: Dataset, frame_index: int, name: str) -> bytes:
    """An image as viewers expect it: linear ones on the sRGB curve, with 16 bits where the sensor has more than 8."""
    sensor = source.manifest.recipe.sensor
    if sensor.encoding == "linear":
        return display_png(source, frame_index, name, 8 if sensor.output_bits == 8 else 16)
    return full_range_png(source, frame_index, name)


def _picture(data: bytes, frame_index: int, name: str) -> dict[str, Any]:
    return {"bytes": data, "path": f"{frame_index:06d}_{name}"}


def _depth_tiff(source: Dataset, record: PairRecord, eye: Eye) -> bytes:
    name = passes_file(eye)
    data, where = source.frames.read(record.frame_index, name), source.frames.where(record.frame_index, name)
    depth_m: NDArray[np.float32] = read_passes(data, where, record.frame.rig.camera)["depth.Z"]
    buffer = io.BytesIO()
    Image.fromarray(depth_m).save(buffer, "TIFF", compression="tiff_adobe_deflate")
    return buffer.getvalue()


def _pose(transform: RigidTransform) -> dict[str, list[float]]:
    quaternion = Rotation.from_matrix(transform.rotation).as_quat(canonical=True)
    return {"translation_m": transform.translation_m.tolist(), "quaternion_xyzw": quaternion.tolist()}


def _objects(source: Dataset, record: PairRecord, eye: Eye, log: ExportLog) -> dict[str, list[Any]]:
    image_id, view = coco_image_id(record.frame_index, eye), view_of(record, eye)
    lists: dict[str, list[Any]] = {name: [] for name in _OBJECTS}
    for seen in annotated_objects(source, record, eye, log):
        is_drogue = seen.label == "drogue"
        lists["id"].append(image_id if is_drogue else coco_feature_id(image_id, seen.marker_index))
        lists["category"].append(CATEGORIES.index(seen.label))
        lists["bbox"].append(list(seen.box))
        lists["area"].append(view.visible_drogue_px if seen.pixels is None else len(seen.pixels))
        lists["marker_index"].append(seen.marker_index)
        lists["visible_fraction"].append(seen.visible_fraction)
    return lists


def _keypoints(record: PairRecord, eye: Eye) -> dict[str, list[Any]]:
    view = view_of(record, eye)
    points = view_keypoints(view, record.frame.rig.camera, 0)
    return {
        "id": list(range(len(points))),
        "point": [[point.x, point.y] for point in points],
        "visibility": [point.flag for point in points],
        "visible_fraction": [marker.visible_fraction for marker in view.markers],
    }


def _camera(record: PairRecord, eye: Eye) -> dict[str, Any]:
    rig = record.frame.rig
    lens = rig.lens(eye) or Lens(rig.camera)
    camera_from_ideal = lens.ideal_from_real.T
    return {
        "matrix": np.asarray(lens.camera.matrix()).tolist(),
        "distortion": lens.distortion.coefficients().tolist(),
        "camera_from_left": _pose(RigidTransform(camera_from_ideal, -camera_from_ideal @ rig.eye_offset_m(eye))),
    }
