"""An animation of a flight: tanker, hose, drogue and receiver from the side, beside what the left camera sees."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.parameters import DrogueParameters
from droguekit.scoring.report.label_drawing import Picture, display_picture, draw_box, draw_crosses, resized
from droguekit.visualization.video_file import WrittenVideo, check_video, evenly, write_pairs
from geometry.se3 import Array, RigidTransform
from render.surfaces import frame_tanker_surfaces

_INCHES, _DPI = (12.8, 5.4), 100
_PICTURE_PX = 640
_STEEL, _HOSE, _DROGUE, _RECEIVER, _VIEW = "#8a96a3", "#222222", "#c8102e", "#3d5a80", "#f2c14e"
# Half the height of the close-up around the drogue. [m]
_CLOSE_M = 1.6
# Our sketch of a receiver, which is not part of the truth. [m]
_BODY_RADIUS_M, _BODY_LENGTH_M, _NOSE_LENGTH_M, _BELOW_EYE_M = 0.5, 7.0, 1.6, 0.6
_RING = 32


def write_animation(dataset: Dataset, path: Path, count: int, sequence_id: int | None) -> WrittenVideo:
    """Draw pairs of a dataset, spread evenly, and write them in the order of time.

    Args:
        dataset: of the pairs.
        path: ends in .gif or .mp4; appears when it is complete.
        count: pairs at most.
        sequence_id: only pairs of this sequence, or None for all.

    Raises:
        ValueError: no such pairs, or one that cannot be read.
        OSError: it cannot be written.
    """
    check_video("--animate", path, count)
    records = [dataset.record(index) for index in _chosen(dataset, count, sequence_id)]
    side_view = SideView(records)
    return write_pairs(
        path, (side_view.draw(record, dataset.images(record.frame_index)) for record in records), records
    )


def _chosen(dataset: Dataset, count: int, sequence_id: int | None) -> list[int]:
    """Indices of the pairs to show, in order."""
    fitting = list(_with_drogue(dataset, sequence_id))
    if not fitting:
        which = "" if sequence_id is None else f" of sequence {sequence_id}"
        raise ValueError(f"{dataset.path}: holds no pairs{which} with drogue and tanker to animate")
    return evenly(fitting, count)


def _with_drogue(dataset: Dataset, sequence_id: int | None) -> Iterator[int]:
    empty = {entry.frame_index for entry in dataset.manifest.frames if entry.empty}
    for index in dataset.frame_indices:
        if index not in empty and (sequence_id is None or dataset.record(index).sequence_id == sequence_id):
            yield index


class SideView:
    """Draws pairs on the same axes."""

    def __init__(self, records: list[PairRecord]) -> None:
        """Set the limits of the axes to contain all pairs.

        Args:
            records: pairs with a drogue and a tanker.
        """
        self._figure = Figure(figsize=_INCHES, dpi=_DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        whole, close, camera = (
            self._figure.add_axes(place)
            for place in ((0.05, 0.60, 0.43, 0.31), (0.05, 0.10, 0.43, 0.41), (0.5, 0.06, 0.49, 0.87))
        )
        self._whole, self._close, self._camera = whole, close, camera
        self._tankers: dict[str, list[PolyCollection]] = {}
        for axes in (whole, close):
            axes.set_aspect("equal", adjustable="box")
            axes.tick_params(labelsize=8)
        places = np.concatenate([_side(_Placed(record).left_eye.translation_m[None]) for record in records])
        farthest_m = float(-places[:, 0].min()) + _BODY_LENGTH_M + 0.5
        whole.set_xlim(-farthest_m, 5.0)
        # The height follows from the width and the shape of the axes, with the hose in the middle.
        height_m = (farthest_m + 5.0) * (0.31 * _INCHES[1]) / (0.43 * _INCHES[0])
        whole.set_ylim(-3.0 - height_m / 2, -3.0 + height_m / 2)
        whole.text(0.99, 0.04, "yellow: what the left camera sees", transform=whole.transAxes, ha="right", fontsize=8)
        close.set_xlabel("metres ahead of the hose's exit (flight to the right)", fontsize=8)
        for axes in (whole, close):
            axes.set_ylabel("metres up", fontsize=8)
        camera.set_axis_off()

    def draw(self, record: PairRecord, images: StereoImages) -> Picture:
        """(H, W, 3) picture of one pair, red, green, blue."""
        placed = _Placed(record)
        self._show_tanker(record.frame)
        moving: list[Artist] = [artist for axes in (self._whole, self._close) for artist in _draw_flight(axes, placed)]
        name = _side(placed.left_eye.apply(_from_eye(np.array([[3.8, -1.3]]))))[0]
        moving.append(
            self._whole.text(
                name[0], name[1], "receiver (sketch)", ha="center", fontsize=8, color=_RECEIVER, clip_on=True
            )
        )
        middle = _side(placed.drogue_pose.translation_m[None])[0]
        half_m = _CLOSE_M * (0.43 * _INCHES[0]) / (0.41 * _INCHES[1])
        # Leaves room for the camera when it is near.
        self._close.set_xlim(middle[0] - 1.35 * half_m, middle[0] + 0.65 * half_m)
        self._close.set_ylim(middle[1] - _CLOSE_M, middle[1] + _CLOSE_M)
        self._camera.clear()
        self._camera.set_axis_off()
        self._camera.imshow(_labelled(record, images), interpolation="nearest")
        distance_m = record.conditions.distance_m
        self._camera.set_title(f"left camera, drogue at {distance_m:.2f} m{_in_view(record)}", fontsize=10)
        which = "" if record.sequence_id is None else f"sequence {record.sequence_id}, "
        self._whole.set_title(f"{which}frame {record.frame_index}, {record.time_s:.2f} s", fontsize=10)
        self._canvas.draw()
        picture = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        for artist in moving:
            artist.remove()
        return picture

    def _show_tanker(self, frame: FrameSpec) -> None:
        """Show the tanker of a pair, which pairs of one scene have in common, and hide the others."""
        name = "" if frame.tanker is None else frame.tanker.model_dump_json()
        if name not in self._tankers:
            corners_m = np.concatenate([part.mesh.triangles for part in frame_tanker_surfaces(frame)])
            triangles = list(_side(corners_m.reshape(-1, 3)).reshape(-1, 3, 2))
            self._tankers[name] = [
                PolyCollection(triangles, facecolors=_STEEL, edgecolors=_STEEL, linewidths=0.3) for _ in range(2)
            ]
            for axes, polygons in zip((self._whole, self._close), self._tankers[name], strict=True):
                axes.add_collection(polygons)
        for shown, collections in self._tankers.items():
            for polygons in collections:
                polygons.set_visible(shown == name)


class _Placed:
    """Poses of a pair in the tanker's axes."""

    def __init__(self, record: PairRecord) -> None:
        frame = record.frame
        if frame.drogue is None or frame.left_from_drogue is None or frame.left_from_tanker is None:
            raise ValueError(f"frame {record.frame_index}: has no drogue or no tanker to draw")
        self.drogue: DrogueParameters = frame.drogue
        self.left_eye = frame.left_from_tanker.inverse()
        self.drogue_pose: RigidTransform = self.left_eye @ frame.left_from_drogue
        nodes = np.zeros((0, 3)) if frame.hose_nodes_left_m is None else frame.hose_nodes_left_m
        self.hose_m = self.left_eye.apply(nodes)
        camera = frame.rig.camera
        self.half_height = (camera.height_px / 2) / camera.fy_px


def _side(points_m: Array) -> Array:
    """(M, 2) ahead and up of (M, 3) points in the tanker's axes (aft, right, up). [m]"""
    return np.stack([-points_m[:, 0], points_m[:, 2]], axis=-1)


def _draw_flight(axes: Axes, placed: _Placed) -> list[Artist]:
    """Hose, drogue, receiver and its camera's field of view, as artists to be removed afterwards."""
    hose = _side(placed.hose_m)
    (line,) = axes.plot(hose[:, 0], hose[:, 1], color=_HOSE, linewidth=2.0, solid_capstyle="round", zorder=3)
    shapes = [(_view_wedge(placed), _VIEW, 0.25, 1), (_drogue_outline(placed), _DROGUE, 1.0, 4)]
    shapes += [(outline, _RECEIVER, 1.0, 2) for outline in _receiver_outlines(placed)]
    artists: list[Artist] = [line]
    for outline, color, alpha, order in shapes:
        patch = Polygon(outline, closed=True, facecolor=color, edgecolor="none", alpha=alpha, zorder=order)
        artists.append(axes.add_patch(patch))
    eye = _side(placed.left_eye.translation_m[None])[0]
    artists += axes.plot(*eye, "o", color="black", markersize=4, zorder=5)
    return artists


def _drogue_outline(placed: _Placed) -> Array:
    """(M, 2) around rim, basket and coupling from the side. [m]"""
    drogue, angle = placed.drogue, 2 * np.pi * np.arange(_RING) / _RING
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(_RING)], axis=-1)
    back_m = drogue.hub_depth_m + drogue.coupling_length_m
    rings = [(drogue.rim_radius_m, 0.0), (drogue.coupling_radius_m, drogue.hub_depth_m)]
    rings.append((drogue.coupling_radius_m, back_m))
    points = np.concatenate([radius_m * circle + np.array([0.0, 0.0, z_m]) for radius_m, z_m in rings])
    # Basket and coupling are convex, their union is not.
    hulls = [_hull(_side(placed.drogue_pose.apply(part))) for part in (points[: 2 * _RING], points[_RING:])]
    return _joined(hulls)


def _hull(points: Array) -> Array:
    corners: Array = points[ConvexHull(points).vertices]
    return corners


def _joined(outlines: list[Array]) -> Array:
    """One outline around all of them in turn; the seams between them coincide."""
    start = outlines[0][:1]
    return np.concatenate([part for outline in outlines for part in (outline, outline[:1], start)])


def _receiver_outlines(placed: _Placed) -> list[Array]:
    """Outlines of body, fin and the mast that holds the cameras. [m]"""
    along = np.linspace(0.0, 1.0, 20)
    half = np.concatenate([_BODY_RADIUS_M * np.sqrt(along), [_BODY_RADIUS_M]])
    back = np.concatenate([_NOSE_LENGTH_M * along, [_BODY_LENGTH_M]])
    outline = np.concatenate([np.stack([back, half], axis=-1), np.stack([back, -half], axis=-1)[::-1]])
    fin = np.array([[5.6, 0.4], [6.5, 1.6], [_BODY_LENGTH_M, 1.6], [_BODY_LENGTH_M, 0.4]])
    mast = np.array([[-0.06, _BELOW_EYE_M], [0.06, _BELOW_EYE_M], [0.5, 0.2], [0.2, 0.1]])
    return [_side(placed.left_eye.apply(_from_eye(part))) for part in (outline, fin, mast)]


def _from_eye(outline: Array) -> Array:
    """(M, 3) right, down, forward of the eye of (M, 2) points behind the nose's tip and up of its axis. [m]"""
    return np.stack([np.zeros(len(outline)), _BELOW_EYE_M - outline[:, 1], -outline[:, 0]], axis=-1)


def _view_wedge(placed: _Placed) -> Array:
    """(3, 2) field of view of the left eye's middle column, to a little beyond the drogue. [m]"""
    depth_m = 1.1 * float((placed.left_eye.inverse() @ placed.drogue_pose).translation_m[2])
    edges = np.array([[0.0, side * placed.half_height * depth_m, depth_m] for side in (-1, 1)])
    return _side(np.concatenate([placed.left_eye.translation_m[None], placed.left_eye.apply(edges)]))


def _labelled(record: PairRecord, images: StereoImages) -> Picture:
    """The left image with the drogue's box and the centres of its markers."""
    picture, scale = resized(display_picture(images), _PICTURE_PX)
    view = record.views.left
    if view.box_full_xywh_px is not None:
        draw_box(picture, view.box_full_xywh_px, scale)
    draw_crosses(picture, [marker.center_ellipse_px for marker in view.markers], scale)
    return picture


def _in_view(record: PairRecord) -> str:
    """The part of the title about markers and hub in the left image."""
    markers = record.views.left.markers
    text = f", {sum(marker.in_image for marker in markers)} of {len(markers)} markers"
    hub = record.views.left.hub
    return text + ("" if hub is None else " and the hub in view" if hub.in_image else " in view, hub not")
