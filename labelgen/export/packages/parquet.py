"""One Parquet table with a row a view: pose, conditions, boxes and features.

Names, units and meaning are those of the records; boxes and points are in pixel-centre coordinates. Columns of markers
are lists in the drogue's order. Missing values, such as the pose of an empty frame, are null.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from datasets_manifest.atomic import part_path, sync_folder
from datasets_manifest.storage.layout import FRAMES_FOLDER, image_file
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import FeatureView, PairRecord, PixelBox
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.coco import coco_image_id
from labelgen.export.export_log import ExportLog
from labelgen.export.keypoints import view_of
from labelgen.label_errors import label_errors

TABLE_FILE = "views.parquet"
_ROWS_AT_ONCE = 2048

_TEXTS = ("view", "split", "file_name", "family", "engine", "drogue")
_INTEGERS = ("frame_index", "image_id", "scene_id", "sequence_id", "width_px", "height_px", "visible_drogue_px")
_FLAGS = ("has_drogue", "truncated")
_NUMBERS = (
    *("time_s", "fx_px", "fy_px", "cx_px", "cy_px", "eye_offset_x_m"),
    *("exposure_time_s", "f_number", "gain"),
    *("sun_elevation_deg", "background_luminance_cd_m2"),
    *("monte_carlo_noise_fraction", "monte_carlo_over_sensor_noise", "distance_m"),
    *("position_x_m", "position_y_m", "position_z_m"),
    *("quaternion_x", "quaternion_y", "quaternion_z", "quaternion_w"),
    *("pitch_deg", "yaw_deg", "roll_deg", "roll_modulo_deg"),
    *(f"box_{kind}_{part}_px" for kind in ("full", "visible") for part in ("x", "y", "width", "height")),
    "marker_signal_to_noise_mean",
)
_FEATURE_NUMBERS = (
    *("center_proj_u_px", "center_proj_v_px", "center_ellipse_u_px", "center_ellipse_v_px"),
    *("visible_fraction", "signal_to_noise"),
)

_ERROR_LISTS = ("marker_center_error_px", "box_full_error_px", "box_visible_error_px")


def write_parquet(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write `views.parquet`.

    Args:
        dataset: the dataset's folder.
        out: folder to write into; a file of this name is replaced.
        log: receives the progress.

    Returns:
        The file.

    Raises:
        ValueError: the dataset cannot be read; names the file.
        OSError: the file cannot be written. It is then left as it was before.
    """
    source = Dataset(dataset)
    splits = source.manifest.split_of_frame()
    schema = _schema(source.manifest)
    path = out / TABLE_FILE
    part = part_path(path)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(part, schema) as writer:
            rows: list[dict[str, Any]] = []
            for record in log.records(source, with_files=False):
                log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
                rows += [view_row(record, eye, splits[record.frame_index]) for eye in EYES]
                if len(rows) >= _ROWS_AT_ONCE:
                    writer.write_table(pa.Table.from_pylist(rows, schema=schema))
                    rows = []
            if rows:
                writer.write_table(pa.Table.from_pylist(rows, schema=schema))
        part.replace(path)
        sync_folder(out)
    except OSError as error:
        raise OSError(error.errno, f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return [path]


def view_row(record: PairRecord, eye: Eye, split: str) -> dict[str, Any]:
    """One row of the table, by column."""
    rig, view, exposure = record.frame.rig, view_of(record, eye), record.frame.exposure
    camera = (rig.lens(eye) or rig).camera
    drogue = record.frame.drogue
    snr = [marker.signal_to_noise for marker in view.markers]
    return {
        "frame_index": record.frame_index,
        "view": eye,
        "image_id": coco_image_id(record.frame_index, eye),
        "split": split,
        "scene_id": record.scene_id,
        "sequence_id": record.sequence_id,
        "file_name": f"{FRAMES_FOLDER}/{record.frame_index:06d}/{image_file(eye)}",
        "engine": record.engine,
        "time_s": record.time_s,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fx_px": camera.fx_px,
        "fy_px": camera.fy_px,
        "cx_px": camera.cx_px,
        "cy_px": camera.cy_px,
        "eye_offset_x_m": float(rig.eye_offset_m(eye)[0]),
        "exposure_time_s": exposure.time_s,
        "f_number": exposure.f_number,
        "gain": exposure.gain,
        **record.conditions.model_dump(),
        "has_drogue": drogue is not None,
        "drogue": None if drogue is None else drogue.name,
        **_pose_columns(record),
        **_box_columns("full", view.box_full_xywh_px),
        **_box_columns("visible", view.box_visible_xywh_px),
        "visible_drogue_px": view.visible_drogue_px,
        "truncated": view.truncated,
        "marker_signal_to_noise_mean": sum(snr) / len(snr) if snr else None,
        **_marker_columns(view.markers),
        **({} if view.hub is None else {f"hub_{name}": number for name, number in _feature_numbers(view.hub).items()}),
        "hub_in_image": None if view.hub is None else view.hub.in_image,
        **_error_columns(record, eye),
    }


def _error_columns(record: PairRecord, eye: Eye) -> dict[str, Any]:
    """Limits on the errors of labels: of centres, and of the left, upper, right and lower sides of boxes."""
    limits = label_errors(record, eye)
    if limits is None:
        return {}
    lists = (limits.markers_px, limits.box_full_px, limits.box_visible_px)
    return {**dict(zip(_ERROR_LISTS, map(list, lists), strict=True)), "hub_center_error_px": limits.hub_px}


def _schema(manifest: Manifest) -> pa.Schema:
    lists = [(f"marker_{name}", pa.list_(pa.float64())) for name in _FEATURE_NUMBERS]
    fields = [
        *((name, pa.int64()) for name in _INTEGERS),
        *((name, pa.string()) for name in _TEXTS),
        *((name, pa.bool_()) for name in _FLAGS),
        *((name, pa.float64()) for name in _NUMBERS),
        ("left_from_drogue", pa.list_(pa.float64())),
        *lists,
        ("marker_in_image", pa.list_(pa.bool_())),
        *((f"hub_{name}", pa.float64()) for name in _FEATURE_NUMBERS),
        ("hub_in_image", pa.bool_()),
        *((name, pa.list_(pa.float64())) for name in _ERROR_LISTS),
        ("hub_center_error_px", pa.float64()),
    ]
    about = {
        "dataset_sha256": manifest.dataset_sha256,
        "name": manifest.name,
        "data_licence": manifest.data_licence,
        "conventions": canonical_json(manifest.conventions),
    }
    return pa.schema(fields, metadata=about)


def _pose_columns(record: PairRecord) -> dict[str, Any]:
    """Position, attitude (quaternion x y z w, and angles) and matrix, row by row, of `left_from_drogue`."""
    pose = record.left_from_drogue
    if pose is None:
        return {}
    x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat(canonical=True).tolist()
    return {
        **dict(zip(("position_x_m", "position_y_m", "position_z_m"), pose.translation_m.tolist(), strict=True)),
        "quaternion_x": x,
        "quaternion_y": y,
        "quaternion_z": z,
        "quaternion_w": w,
        "pitch_deg": record.pitch_deg,
        "yaw_deg": record.yaw_deg,
        "roll_deg": record.roll_deg,
        "roll_modulo_deg": record.roll_modulo_deg,
        "left_from_drogue": pose.as_matrix().ravel().tolist(),
    }


def _box_columns(kind: str, box: PixelBox | None) -> dict[str, float]:
    names = (f"box_{kind}_{part}_px" for part in ("x", "y", "width", "height"))
    return {} if box is None else dict(zip(names, box, strict=True))


def _feature_numbers(feature: FeatureView) -> dict[str, float]:
    numbers = (
        *feature.center_proj_px,
        *feature.center_ellipse_px,
        feature.visible_fraction,
        feature.signal_to_noise,
    )
    return dict(zip(_FEATURE_NUMBERS, numbers, strict=True))


def _marker_columns(markers: tuple[FeatureView, ...]) -> dict[str, list[Any]]:
    rows = [_feature_numbers(marker) for marker in markers]
    return {
        **{f"marker_{name}": [row[name] for row in rows] for name in _FEATURE_NUMBERS},
        "marker_in_image": [marker.in_image for marker in markers],
    }
