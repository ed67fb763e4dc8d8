"""A dataset with its truth in the rerun viewer: what is logged of each pair, into a recording or an open viewer.

Everything is in the left camera's frame, `rig`. The viewer counts pixels from the image's corner, half a pixel more
than the dataset.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from datasets_manifest.atomic import part_path
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.estimates import Estimate, PoseEstimate
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord, PixelBox, ViewRecord
from drogue_models.drogue_surfaces import drogue_surfaces
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.parameters import DrogueParameters
from droguekit.batch.progress import ProgressReport
from droguekit.scoring.poses.pose_errors import pose_error
from droguekit.scoring.report.label_drawing import BOX_RGB, MARKER_RGB, Rgb, display_picture
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig
from render.surfaces import frame_tanker_surfaces

Faces = NDArray[np.int64]
_Body = TypeVar("_Body")
APPLICATION = "droguekit"
FRAMES, SECONDS = "frame", "time"
CURVES = ("position_mm", "pitch_deg", "yaw_deg")
_HUB_RGB: Rgb = (255, 120, 220)
_STEEL_RGB: Rgb = (138, 150, 163)
_HOSE_RGB: Rgb = (70, 70, 76)
# Colours of methods, repeated if there are more; bright enough for the viewer's black background.
_METHOD_RGB: tuple[Rgb, ...] = (
    (255, 138, 31),
    (90, 170, 255),
    (90, 210, 110),
    (255, 95, 115),
    (185, 145, 255),
    (60, 210, 220),
)
# Sizes on the screen, whatever the image's scale.
_TRUE_POINTS, _MEASURED_POINTS, _WIRES = (
    np.atleast_1d(np.asarray(rr.Radius.ui_points(size))) for size in (2.5, 1.5, 1.0)
)
# The chords of a rim of 0.35 m are then at most 0.4 mm off.
_CIRCLE_POINTS = 64
_QUALITY = 80
_IMAGE_PLANE_M = 0.6


class ShownPair(NamedTuple):
    """A pair: its images, the rig, the drogue that is or would be in view, and its truth or None."""

    frame_index: int
    images: StereoImages
    rig: StereoRig
    drogue: DrogueParameters | None
    record: PairRecord | None


class ShownPairs(NamedTuple):
    """Indices of a dataset's pairs, ascending, and a function that reads one."""

    frame_indices: tuple[int, ...]
    read: Callable[[int], ShownPair]


def open_pairs(dataset: Location) -> ShownPairs:
    """The pairs of a dataset, with or without truth.

    Raises:
        ValueError: no dataset there, or one that cannot be trusted.
    """
    if open_storage(dataset).exists(BLIND_FILE):
        blind = BlindDataset(dataset)

        def read_blind(index: int) -> ShownPair:
            pair = blind.pair(index)
            return ShownPair(index, pair.images, pair.rig, pair.drogue, None)

        return ShownPairs(blind.frame_indices, read_blind)
    source = Dataset(dataset)

    def read(index: int) -> ShownPair:
        record = source.record(index)
        drogue = source.sought_drogue(record)
        return ShownPair(index, source.images(index), record.frame.rig, drogue, record)

    return ShownPairs(source.frame_indices, read)


class PairRecorder:
    """Logs pairs into a recording."""

    def __init__(self, recording: rr.RecordingStream, rig: StereoRig, methods: Sequence[str]) -> None:
        """Log what does not change.

        Args:
            recording: to a file or a viewer.
            rig: the cameras.
            methods: names of the methods with estimates.
        """
        self._to = recording
        self._methods = {name: _METHOD_RGB[k % len(_METHOD_RGB)] for k, name in enumerate(methods)}
        # What each visible body was drawn from.
        self._shown: dict[str, object] = {}
        self._log("rig", rr.ViewCoordinates.RDF, static=True)
        for eye in EYES:
            self._log(f"rig/{eye}", *_eye(rig, eye), static=True)
        for curve in CURVES:
            for name, color in self._methods.items():
                self._log(_path("errors", curve, name), rr.SeriesLines(colors=[color], names=[name]), static=True)

    def add(self, pair: ShownPair, estimates: Mapping[str, Estimate]) -> None:
        """Log a pair and the methods' estimates of it."""
        rr.set_time(FRAMES, sequence=pair.frame_index, recording=self._to)
        rr.set_time(SECONDS, duration=pair.images.time_s, recording=self._to)
        self._add_images(pair)
        if pair.record is not None:
            self._add_truth(pair)
        for method in self._methods:
            self._add_estimate(method, estimates.get(method), pair)

    def _log(self, path: str, *what: rr.AsComponents, static: bool = False) -> None:
        rr.log(path, *what, static=static, recording=self._to)

    def _clear(self, path: str) -> None:
        self._log(path, rr.Clear(recursive=True))

    def _show(
        self, path: str, body: _Body | None, pose: RigidTransform | None, draw: Callable[[_Body], rr.AsComponents]
    ) -> None:
        """Place a body, or remove it; its shape is sent only when it changes."""
        if body is None or pose is None:
            self._clear(path)
            self._shown.pop(path, None)
            return
        if self._shown.get(path) != body:
            self._log(f"{path}/body", draw(body))
            self._shown[path] = body
        self._log(path, rr.Transform3D(translation=pose.translation_m, mat3x3=pose.rotation))

    def _add_images(self, pair: ShownPair) -> None:
        for eye in EYES:
            picture = display_picture(replace(pair.images, left=getattr(pair.images, eye)))
            _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            self._log(f"rig/{eye}/image", rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg"))

    def _add_truth(self, pair: ShownPair) -> None:
        record = pair.record
        if record is None:
            return
        frame = record.frame
        self._show("rig/drogue", frame.drogue, record.left_from_drogue, _drogue)
        self._show("rig/tanker", frame_tanker_surfaces(frame), frame.left_from_tanker, _tanker)
        if frame.hose_nodes_left_m is None or frame.drogue is None:
            self._clear("rig/hose")
        else:
            radius_m = frame.drogue.hose_radius_m
            self._log("rig/hose", rr.LineStrips3D([frame.hose_nodes_left_m], radii=[radius_m], colors=[_HOSE_RGB]))
        if record.conditions.distance_m is None:
            self._clear("distance_m")
        else:
            self._log("distance_m", rr.Scalars(record.conditions.distance_m))
        for eye, view in (("left", record.views.left), ("right", record.views.right)):
            self._add_view(f"rig/{eye}", view)

    def _add_view(self, path: str, view: ViewRecord) -> None:
        for name, box in (("box_full", view.box_full_xywh_px), ("box_visible", view.box_visible_xywh_px)):
            if box is None:
                self._clear(f"{path}/{name}")
            else:
                self._log(f"{path}/{name}", _box(box))
        seen = [marker.center_ellipse_px for marker in view.markers if marker.visible_fraction > 0]
        self._log(f"{path}/markers", rr.Points2D(_corner_px(seen), colors=[MARKER_RGB], radii=_TRUE_POINTS))
        hubs = [view.hub.center_ellipse_px] if view.hub is not None and view.hub.visible_fraction > 0 else []
        self._log(f"{path}/hub", rr.Points2D(_corner_px(hubs), colors=[_HUB_RGB], radii=_TRUE_POINTS))

    def _add_estimate(self, method: str, estimate: Estimate | None, pair: ShownPair) -> None:
        pose = estimate.left_from_drogue if isinstance(estimate, PoseEstimate) else None
        color = self._methods[method]
        self._show(_path("rig", "estimates", method), pair.drogue, pose, partial(_wires, color=color))
        for eye in EYES:
            found = [f.center_px for f in estimate.features if f.eye == eye] if estimate is not None else []
            points = rr.Points2D(_corner_px(found), colors=[color], radii=_MEASURED_POINTS)
            self._log(_path("rig", eye, "measured", method), points)
        truth = None if pair.record is None else pair.record.left_from_drogue
        if pose is None or truth is None:
            # Leaves a gap in the curves, where a line would suggest fixes.
            for curve in CURVES:
                self._clear(_path("errors", curve, method))
            return
        error = pose_error(pose, truth)
        values = (1e3 * error.position_m, float(error.components[3]), float(error.components[4]))
        for curve, value in zip(CURVES, values, strict=True):
            self._log(_path("errors", curve, method), rr.Scalars(value))


def blueprint() -> rrb.Blueprint:
    """The viewer's layout: two 3-D views on the left, images and error curves on the right."""
    whole = rrb.Spatial3DView(origin="rig", name="left camera's frame")
    close = rrb.Spatial3DView(
        origin="rig/drogue", contents=["rig/drogue/**", "rig/estimates/**"], name="drogue, true and estimated"
    )
    eyes = rrb.Horizontal(*(rrb.Spatial2DView(origin=f"rig/{eye}", name=f"{eye} eye") for eye in EYES))
    curves = [rrb.TimeSeriesView(origin=f"errors/{curve}", name=f"error, {curve}") for curve in CURVES]
    curves.append(rrb.TimeSeriesView(origin="distance_m", name="distance [m]"))
    left, right = rrb.Vertical(whole, close), rrb.Vertical(eyes, rrb.Tabs(*curves), row_shares=[3, 2])
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[2, 3]), collapse_panels=True)


@lru_cache(maxsize=8)
def _drogue(drogue: DrogueParameters) -> rr.Mesh3D:
    """The drogue's parts as one coloured mesh."""
    colored = [(painted, _screen_color(painted.mean_reflectance)) for painted in drogue_surfaces(drogue).values()]
    return _colored_mesh(colored)


def _wires(drogue: DrogueParameters, color: Rgb) -> rr.LineStrips3D:
    """Rim, opening, markers and hub as circles; a second mesh in nearly the same place would flicker."""
    middle = (0.0, 0.0, 0.0)
    circles = [(middle, drogue.rim_radius_m), (middle, drogue.opening_radius_m)]
    circles += [(center, drogue.marker_radius_m) for center in drogue.marker_centers_m]
    if drogue.hub is not None:
        circles.append(((0.0, 0.0, drogue.hub.depth_m), drogue.hub.outer_radius_m))
    itself = RigidTransform.identity()
    outlines = [disc_outline(itself, center_m, radius_m, _CIRCLE_POINTS) for center_m, radius_m in circles]
    closed = [np.concatenate([outline, outline[:1]]) for outline in outlines]
    return rr.LineStrips3D(closed, radii=_WIRES, colors=[color])


def _screen_color(reflectance_rgb: Array) -> Array:
    """(3,) reflectance as screen colour, 0 to 255."""
    color: Array = 255.0 * reflectance_rgb ** (1 / 2.2)
    return color


def _colored_mesh(colored: Iterable[tuple[PaintedMesh, ArrayLike]]) -> rr.Mesh3D:
    """Several surfaces, each in one colour (0 to 255), as one mesh."""
    vertices, faces, colors, count = [], [], [], 0
    for painted, color in colored:
        mesh = painted.mesh
        vertices.append(np.asarray(mesh.vertices))
        faces.append(np.asarray(mesh.faces) + count)
        colors.append(np.tile(np.asarray(color), (len(mesh.vertices), 1)))
        count += len(mesh.vertices)
    return _mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors).astype(np.uint8))


def _mesh(vertices: Array, faces: Faces, colors: NDArray[np.uint8]) -> rr.Mesh3D:
    """Flat-shaded triangles: each has its own vertices with its normal."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        vertex_normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        vertex_colors=colors[faces].reshape(-1, 3),
    )


def _tanker(surfaces: tuple[PaintedMesh, ...]) -> rr.Mesh3D:
    return _colored_mesh((painted, _STEEL_RGB) for painted in surfaces)


def _eye(rig: StereoRig, eye: Eye) -> tuple[rr.Transform3D, rr.Pinhole]:
    """Pose and intrinsics of the camera of an image; the viewer has no distortion."""
    lens = rig.lens(eye)
    camera = rig.camera if lens is None else lens.camera
    rotation = np.eye(3) if lens is None else lens.ideal_from_real
    pinhole = rr.Pinhole(
        focal_length=(camera.fx_px, camera.fy_px),
        principal_point=(camera.cx_px + 0.5, camera.cy_px + 0.5),
        width=camera.width_px,
        height=camera.height_px,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_IMAGE_PLANE_M,
    )
    return rr.Transform3D(translation=rig.eye_offset_m(eye), mat3x3=rotation), pinhole


def _corner_px(points_px: Sequence[tuple[float, float]]) -> Array:
    """(M, 2) points measured from the image's corner. [px]"""
    return np.asarray(points_px, dtype=np.float64).reshape(-1, 2) + 0.5


def _box(box: PixelBox) -> rr.Boxes2D:
    x, y, width, height = box
    return rr.Boxes2D(array=[[x + 0.5, y + 0.5, width, height]], array_format=rr.Box2DFormat.XYWH, colors=[BOX_RGB])


def _path(*parts: str) -> str:
    """An entity's path, escaped, since methods may have any name."""
    path: str = rr.new_entity_path(list(parts))
    return path


# Only this machine can connect to the viewer.
_HOST = "127.0.0.1"
# Longest time for the viewer to open, and time in which it fails if it gets no window. [s]
_OPEN_TIMEOUT_S, _WINDOW_TIMEOUT_S = 30.0, 2.0


@dataclass(frozen=True)
class ViewSummary:
    """Indices of the shown pairs, and a line for each pair that could not be read."""

    shown: tuple[int, ...]
    faults: tuple[str, ...]


def view_pairs(
    source: ShownPairs,
    frames: Sequence[int],
    estimates: Mapping[str, Mapping[int, Estimate]],
    save: Path | None,
    report: ProgressReport,
) -> ViewSummary:
    """Show pairs with estimates.

    Args:
        source: the dataset.
        frames: indices of the pairs, in order.
        estimates: by method and frame.
        save: an .rrd file, which appears when it is complete and is not written without pairs; None opens a viewer.
        report: is told of the progress.

    Raises:
        OSError: the file cannot be written, or no viewer can be opened.
    """
    # A new id for each: the viewer would join recordings of the same id.
    recording = rr.RecordingStream(APPLICATION)
    if save is None:
        _open_viewer(recording)
        return _log_pairs(recording, source, frames, estimates, report)
    part = part_path(save)
    try:
        save.parent.mkdir(parents=True, exist_ok=True)
        # The library reports no failed writes; this one is ours.
        part.touch(exist_ok=False)
        rr.save(part, default_blueprint=blueprint(), recording=recording)
        summary = _log_pairs(recording, source, frames, estimates, report)
        rr.disconnect(recording=recording)
        _check_recording(part, len(summary.shown))
        if summary.shown:
            part.replace(save)
    except OSError as error:
        raise OSError(error.errno, f"{save}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return summary


def _open_viewer(recording: rr.RecordingStream) -> None:
    """Open a viewer and connect to it.

    Raises:
        OSError: it does not open; the library would silently drop all data.
    """
    port = _free_port()
    # The viewer that came with the library; it stays open when this process ends.
    command = [sys.executable, "-m", "rerun_cli", "--bind", _HOST, "--port", str(port)]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    until_s = time.monotonic() + _OPEN_TIMEOUT_S
    while viewer.poll() is None and not _answers(port) and time.monotonic() < until_s:
        time.sleep(0.2)
    # It listens before it has a window, and exits when it gets none.
    with suppress(subprocess.TimeoutExpired):
        viewer.wait(_WINDOW_TIMEOUT_S)
    if viewer.returncode is not None or not _answers(port):
        with suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGKILL)
        raise OSError(None, "the viewer does not open; write a recording with --save FILE.rrd")
    rr.connect_grpc(f"rerun+http://{_HOST}:{port}/proxy", default_blueprint=blueprint(), recording=recording)


def _free_port() -> int:
    """A free port instead of the default one, where another program or viewer may listen."""
    with socket.socket() as held:
        held.bind((_HOST, 0))
        return int(held.getsockname()[1])


def _answers(port: int) -> bool:
    try:
        with socket.create_connection((_HOST, port), timeout=1.0):
            return True
    except OSError:
        return False


def _log_pairs(
    recording: rr.RecordingStream,
    source: ShownPairs,
    frames: Sequence[int],
    estimates: Mapping[str, Mapping[int, Estimate]],
    report: ProgressReport,
) -> ViewSummary:
    recorder, shown, faults = None, [], []
    report.begin("pairs", len(frames))
    try:
        for index in frames:
            try:
                pair = source.read(index)
            except ValueError as error:
                faults.append(f"frame {index} is left out: {error}")
            else:
                recorder = recorder or PairRecorder(recording, pair.rig, list(estimates))
                recorder.add(pair, {name: found[index] for name, found in estimates.items() if index in found})
                shown.append(index)
            report.advance()
    finally:
        report.end()
    recording.flush()
    return ViewSummary(tuple(shown), tuple(faults))


def _check_recording(path: Path, pairs: int) -> None:
    """Read the file again.

    Raises:
        OSError: it does not hold all pairs.
    """
    try:
        found = _count_images(path) if pairs else 0
    except (ValueError, RuntimeError) as error:
        raise OSError(None, "what was written cannot be read again; is the disk full?") from error
    if found != pairs:
        raise OSError(None, f"only {found} of {pairs} pairs are in it; is the disk full?")


def _count_images(path: Path) -> int:
    """Left images in a file, by the reader that this version of rerun has.

    Raises:
        ValueError, RuntimeError: the file cannot be read.
    """
    if hasattr(rr, "dataframe"):  # up to rerun 0.23, the last for numpy 1
        view = rr.dataframe.load_recording(path).view(index=FRAMES, contents="rig/left/image")
        return int(view.select(columns=[FRAMES]).read_all().num_rows)
    from rerun.chunk import RrdReader

    return sum(chunk.num_rows for chunk in RrdReader(path).stream() if chunk.entity_path == "/rig/left/image")
