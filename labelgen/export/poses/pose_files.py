"""True poses as SPEED+'s JSON lists, and trajectories as the TUM RGB-D benchmark's text.

Of SPEED+ (doi:10.25740/wv398fc4383), a folder an eye is a data set of its own. `camera.json` describes the delivered
images of the eye; `train.json`, `validation.json` and `test.json` list file name, attitude and position; the pictures
lie under `images`. In its names, `tango` is the target, here the drogue, and `vbs` the camera: `r_Vo2To_vbs_true` is
the drogue's origin in the eye's axes [m], and `q_vbs2tango_true`, scalar first, has the rotation matrix that takes
coordinates in the drogue to the eye. Both belong to the delivered image: behind real eyes to the turned and shifted
camera that took it.

Trajectories are of the drogue in the left camera, a file a sequence. Source: the benchmark's page on its file formats;
evo reads it as `tum`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.blind import read_blind_index
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.reader import Dataset, read_shutter
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.estimates import TANGENT, PoseEstimate, read_estimates
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from geometry.distortion import Lens
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.export.export_log import ExportLog, SequenceOrder, sequence_name
from labelgen.export.frame_files import export_image

# A roll of which nothing is known has a standard deviation of pi / sqrt(3); rings of markers bound it by far less.
_OPEN_ROLL_SD_RAD = 1.0
_SPEED_LISTS = {"train": "train.json", "val": "validation.json", "test": "test.json"}


def write_speed(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write camera, pose lists and images of both eyes.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: counts what the lists lack: images without a drogue, and drogues beside the sought one.

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
            log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
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


TRUTH_FOLDER = "truth"

_HEADER = (
    "# drogue in the left camera (x right, y down, z forward) at mid-exposure\n# time_s tx_m ty_m tz_m qx qy qz qw\n"
)

_FOLDER_NAME = re.compile(r"[A-Za-z0-9][-+.\w]*")


def write_tum(dataset: Location, out: Path, log: ExportLog, estimates: Path | None = None) -> list[Path]:
    """Write a file for each sequence, with a line for each pair.

    With estimates, the truth is in the folder `truth` and each method's poses are in a folder of its name, in files of
    the same names. Methods know the attitude only up to a turn that maps the ring of markers onto itself; of these
    attitudes the one nearest the truth is written. A dataset without truth has no such folder, and attitudes as
    estimated.

    Args:
        dataset: folder.
        out: folder to make.
        log: receives the progress, and counts pairs without a pose and drogues beside the sought one.
        estimates: file of a method's or several methods' estimates, or None for the truth alone.

    Returns:
        The files; with estimates the folders.

    Raises:
        ValueError: a record or an estimate that cannot be read, times that do not ascend, or estimates of another
            dataset.
        OSError: it cannot be written; nothing half-written is left.
    """
    if estimates is not None:
        with new_folder(out) as folder:
            names = _write_estimates(dataset, folder, log, estimates)
        return [out / name for name in names]
    order, names = SequenceOrder(), []
    with new_folder(out) as folder:
        stamped = _stamped(order, log.records(Dataset(dataset), with_files=False))
        for sequence_id, pairs in groupby(stamped, key=lambda pair: pair[0].sequence_id):
            names.append(f"{sequence_name(sequence_id)}.txt")
            with (folder / names[-1]).open("w", encoding="utf-8") as stream:
                stream.write(_HEADER)
                for record, stamp_ns in pairs:
                    log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
                    if record.left_from_drogue is None:
                        log.lost("pairs without a drogue are left out")
                        continue
                    stream.write(_line(record.left_from_drogue, stamp_ns))
    return [out / name for name in names]


def _stamped(order: SequenceOrder, records: Iterator[PairRecord]) -> Iterator[tuple[PairRecord, int]]:
    for record in records:
        yield record, order.stamp_ns(record)


def _line(pose: RigidTransform, stamp_ns: int) -> str:
    seconds, nanoseconds = divmod(abs(stamp_ns), 10**9)
    numbers = [*pose.translation_m.tolist(), *Rotation.from_matrix(pose.rotation).as_quat().tolist()]
    return f"{'-' * (stamp_ns < 0)}{seconds}.{nanoseconds:09d} " + " ".join(repr(number) for number in numbers) + "\n"


def _write_estimates(dataset: Location, folder: Path, log: ExportLog, estimates: Path) -> list[str]:
    """Write truth and estimates, and return the names of their folders."""
    methods = _poses_by_method(estimates)
    has_truth = not open_storage(dataset).exists(BLIND_FILE)
    pairs = Dataset(dataset).frame_indices if has_truth else read_blind_index(dataset).frames
    strange = {index for poses in methods.values() for index in poses} - set(pairs)
    if strange:
        raise ValueError(f"{estimates}: frame {min(strange)} is not in the dataset")
    with ExitStack() as stack:
        writer = _TrajectoryFolders(stack, folder, [*([TRUTH_FOLDER] if has_truth else []), *methods])
        for frame_index, stamp_ns, name, record in _places(dataset, log, has_truth):
            truth = None if record is None else record.left_from_drogue
            if record is not None:
                log.lost("drogues beside the sought one: left out", len(record.frame.neighbours))
                log.lost("pairs without a drogue are left out of the truth", int(truth is None))
            if truth is not None:
                writer.add(TRUTH_FOLDER, name, _line(truth, stamp_ns))
            for method, poses in methods.items():
                estimate = poses.get(frame_index)
                if estimate is None:
                    log.lost(f"pairs in which {method} gives no pose are left out")
                    continue
                pose = estimate.pose
                if estimate.is_roll_open:
                    shown = "a placeholder" if truth is None else "the truth's"
                    log.lost(f"poses of {method} leave the roll open: it is {shown}")
                    pose = pose if truth is None else _with_roll_of(truth, pose)
                elif record is not None and truth is not None:
                    pose = _nearest_turn(pose, truth, _turns(record))
                writer.add(method, name, _line(pose, stamp_ns))
    return writer.names


class _Estimated(NamedTuple):
    """A pose, and whether its roll about the drogue's axis is unknown."""

    pose: RigidTransform
    is_roll_open: bool


def _is_roll_open(estimate: PoseEstimate) -> bool:
    if estimate.covariance is None or estimate.tangent != TANGENT:
        return False
    axis = estimate.left_from_drogue.rotation[:, 2]
    return float(axis @ np.asarray(estimate.covariance)[3:, 3:] @ axis) > _OPEN_ROLL_SD_RAD**2


def _poses_by_method(estimates: Path) -> dict[str, dict[int, _Estimated]]:
    methods: dict[str, dict[int, _Estimated]] = {}
    for estimate in read_estimates(estimates):
        if _FOLDER_NAME.fullmatch(estimate.method) is None or estimate.method == TRUTH_FOLDER:
            raise ValueError(f"{estimates}: method {estimate.method!r} cannot be a folder")
        poses = methods.setdefault(estimate.method, {})
        if estimate.frame_index in poses:
            raise ValueError(f"{estimates}: method {estimate.method!r}: frame {estimate.frame_index} occurs twice")
        if isinstance(estimate, PoseEstimate):
            poses[estimate.frame_index] = _Estimated(estimate.left_from_drogue, _is_roll_open(estimate))
    if not methods:
        raise ValueError(f"{estimates}: holds no estimates")
    return methods


def _places(dataset: Location, log: ExportLog, has_truth: bool) -> Iterator[tuple[int, int, str, PairRecord | None]]:
    """Frame index, time stamp [ns], name of the sequence and record, if there is one, of every pair."""
    if has_truth:
        order = SequenceOrder()
        for record in log.records(Dataset(dataset), with_files=False):
            yield record.frame_index, order.stamp_ns(record), sequence_name(record.sequence_id), record
        return
    frames = FrameStore(dataset)
    last_ns: int | None = None
    for frame_index in read_blind_index(dataset).frames:
        stamp_ns = round(read_shutter(frames, frame_index).time_s * 1e9)
        if last_ns is not None and stamp_ns <= last_ns:
            raise ValueError(f"frame {frame_index}: time_s: must be later than the pair's before it")
        last_ns = stamp_ns
        yield frame_index, stamp_ns, sequence_name(None), None


def _turns(record: PairRecord) -> NDArray[np.float64]:
    """(S, 3, 3) turns about the drogue's axis that map its ring of markers onto itself."""
    assert record.frame.drogue is not None
    count = marker_layout(record.frame.drogue).symmetry_order
    turns: NDArray[np.float64] = Rotation.from_euler("z", 2 * np.pi * np.arange(count)[:, None] / count).as_matrix()
    return turns


def _nearest_turn(pose: RigidTransform, truth: RigidTransform, turns: NDArray[np.float64]) -> RigidTransform:
    turned = pose.rotation @ turns
    # The angle between two attitudes is the smaller, the larger the trace of their quotient.
    nearest = int(np.einsum("ij,nij->n", truth.rotation, turned).argmax())
    return RigidTransform(turned[nearest], pose.translation_m)


def _with_roll_of(truth: RigidTransform, pose: RigidTransform) -> RigidTransform:
    """The pose, turned about its drogue's axis to the attitude nearest the truth's."""
    apart = truth.rotation.T @ pose.rotation
    # The turn that makes the trace of their quotient largest.
    roll_rad = np.arctan2(apart[0, 1] - apart[1, 0], apart[0, 0] + apart[1, 1])
    return RigidTransform(pose.rotation @ Rotation.from_euler("z", roll_rad).as_matrix(), pose.translation_m)


class _TrajectoryFolders:
    """A folder for each trajectory, with a file for each sequence, one open at a time in each."""

    def __init__(self, stack: ExitStack, folder: Path, names: list[str]) -> None:
        self._stack, self._folder, self.names = stack, folder, names
        self._open: dict[str, tuple[str, IO[str]]] = {}
        for name in names:
            (folder / name).mkdir()

    def add(self, name: str, sequence: str, line: str) -> None:
        """Append a pose."""
        open_sequence, stream = self._open.get(name, ("", None))
        if stream is None or open_sequence != sequence:
            if stream is not None:
                stream.close()
            path = self._folder / name / f"{sequence}.txt"
            stream = self._stack.enter_context(path.open("w", encoding="utf-8", newline="\n"))
            stream.write(_HEADER)
            self._open[name] = sequence, stream
        stream.write(line)
