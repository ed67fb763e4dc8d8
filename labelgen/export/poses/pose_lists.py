"""True poses as SPEED+'s JSON lists, a folder an eye.

A folder is a data set of its own. `camera.json` describes the delivered images of the eye; `train.json`,
`validation.json` and `test.json` list file name, attitude and position; the pictures lie under `images`. The names are
those of SPEED+ (doi:10.25740/wv398fc4383), in which `tango` is the target, here the drogue, and `vbs` the camera:
`r_Vo2To_vbs_true` is the drogue's origin in the eye's axes [m], and `q_vbs2tango_true`, scalar first, has the rotation
matrix that takes coordinates in the drogue to the eye. Both belong to the delivered image: behind real eyes to the
turned and shifted camera that took it.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from scipy.spatial.transform import Rotation

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.records import PairRecord
from geometry.distortion import Lens
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.export.export_log import ExportLog
from labelgen.export.frame_files import export_image

_SPEED_LISTS = {"train": "train.json", "val": "validation.json", "test": "test.json"}


def write_speed(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write camera, pose lists and images of both eyes.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts images without a drogue, which the format cannot list.

    Returns:
        The folders of the eyes.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source = Dataset(dataset)
    recipe, splits = source.manifest.recipe, source.manifest.split_of_frame()
    with new_folder(out) as folder, ExitStack() as stack:
        lists: dict[tuple[Eye, str], _PoseList] = {}
        for eye in EYES:
            (folder / eye / "images").mkdir(parents=True)
            camera = canonical_json(speed_camera(recipe.rig, recipe.sensor, eye)) + "\n"
            (folder / eye / "camera.json").write_text(camera, encoding="utf-8", newline="\n")
            for split in sorted(set(splits.values())):
                lists[eye, split] = _PoseList(stack, folder / eye / _SPEED_LISTS[split])
        for record in log.records(source):
            for eye in EYES:
                name = f"img{record.frame_index:06d}.png"
                export_image(source, record.frame_index, eye, folder / eye / "images" / name, log)
                pose = speed_pose(record, eye)
                if pose is None:
                    log.lost("images without a drogue: among the images, but in no list, for they have no pose")
                else:
                    lists[eye, splits[record.frame_index]].add({"filename": name, **pose})
        for pose_list in lists.values():
            pose_list.finish()
    return [out / eye for eye in EYES]


def speed_pose(record: PairRecord, eye: Eye) -> dict[str, Any] | None:
    """Attitude and position of the drogue in the eye that took the image; None without a drogue."""
    pose = record.left_from_drogue
    if pose is None:
        return None
    real_from_ideal = _lens(record.frame.rig, eye).ideal_from_real.T
    rotation = Rotation.from_matrix(real_from_ideal @ pose.rotation)
    x, y, z, w = rotation.as_quat(canonical=True)
    position_m = real_from_ideal @ (pose.translation_m - record.frame.rig.eye_offset_m(eye))
    return {
        "q_vbs2tango_true": [float(w), float(x), float(y), float(z)],
        "r_Vo2To_vbs_true": [float(number) for number in position_m],
    }


def speed_camera(rig: StereoRig, sensor: Sensor, eye: Eye) -> dict[str, Any]:
    """The eye in the names of SPEED+'s `camera.json`: sizes in pixels, pitch and focal length in metres."""
    lens = _lens(rig, eye)
    camera, pitch_m = lens.camera, sensor.optics.pixel_pitch_um * 1e-6
    return {
        "Nu": camera.width_px,
        "Nv": camera.height_px,
        "ppx": pitch_m,
        "ppy": pitch_m,
        "fx": camera.fx_px * pitch_m,
        "fy": camera.fy_px * pitch_m,
        "ccx": camera.cx_px,
        "ccy": camera.cy_px,
        "cameraMatrix": np.asarray(camera.matrix()).tolist(),
        "distCoeffs": lens.distortion.coefficients().tolist(),
    }


def _lens(rig: StereoRig, eye: Eye) -> Lens:
    return rig.lens(eye) or Lens(rig.camera)


class _PoseList:
    """One JSON list that grows entry by entry."""

    def __init__(self, stack: ExitStack, path: Path) -> None:
        self._stream: IO[str] = stack.enter_context(path.open("w", encoding="utf-8", newline="\n"))
        self._stream.write("[")
        self._begun = False

    def add(self, entry: dict[str, Any]) -> None:
        """Append one image."""
        self._stream.write((",\n" if self._begun else "\n") + canonical_json(entry))
        self._begun = True

    def finish(self) -> None:
        """Close the list."""
        self._stream.write("\n]\n")
