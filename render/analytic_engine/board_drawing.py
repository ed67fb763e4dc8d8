"""A calibration board with exact coverage of every pixel by its squares, through any lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from datasets_manifest.types.appearance import CalibrationBoard, PlacedBoard
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import Part
from geometry.se3 import Array
from geometry.stereo import Eye
from render.analytic_engine.flat_drogue import FlatSurfaceLight
from render.analytic_engine.pixel_coverage import image_area, pixel_coverage
from render.analytic_engine.ring_passes import PixelPasses, empty_passes
from render.engine import EyeRadiance
from scenes.environment_radiance import environment_radiance

# A lens curves lines. An edge of 150 px, at twice the curvature of a strong lens (2e-4 / px), deviates by 0.6 px from a
# straight line, and by 0.6 / 64^2 = 1.4e-4 px over each of this many pieces.
_PIECES_PER_SQUARE = 64


def board_eye(frame: FrameSpec, placed: PlacedBoard, eye: Eye, background: NDArray[np.float32]) -> EyeRadiance:
    """Radiance and passes of one eye in a frame with a board.

    Args:
        frame: gives rig, light and air.
        placed: the frame's board.
        eye: which eye.
        background: (H, W, 3) radiance. [cd/m2]

    Raises:
        ValueError: part of the board is not in front of the camera, or it shows its back.
    """
    pose = placed.left_from_board
    corners_m = pose.apply(placed.shape.outline_m())
    if corners_m[:, 2].min() <= 0:
        raise ValueError(f"left_from_board: all of it must be in front of the camera, got {corners_m[:, 2].min():g} m")
    if (pose.translation_m - frame.rig.eye_offset_m(eye)) @ pose.rotation[:, 2] <= 0:
        raise ValueError("left_from_board: the board must show its squares to both eyes; its z axis points away")
    light, depth_m = (
        FlatSurfaceLight(frame, environment_radiance(frame.environment), pose),
        float(pose.translation_m[2]),
    )
    white, black = (
        light.radiance(np.full(3, reflectance), 0.0, depth_m).astype(np.float32)
        for reflectance in (placed.shape.white_reflectance, placed.shape.black_reflectance)
    )
    image = background.copy()
    coverage = np.zeros(background.shape[:2], dtype=np.float32)
    height_px, width_px = coverage.shape
    plate = pixel_coverage([_plate_area(frame, placed, eye)], width_px, height_px)
    if plate is not None:
        share = plate.share.astype(np.float32)
        window = plate.rows, plate.columns
        coverage[window] = share
        image[window] += share[..., None] * (white - background[window])
    squares = pixel_coverage([_black_area(frame, placed, eye)], width_px, height_px)
    if squares is not None:
        image[squares.rows, squares.columns] += squares.share.astype(np.float32)[..., None] * (black - white)
    return EyeRadiance(radiance_cd_m2=image, coverage=coverage, **vars(_passes(frame, placed, eye, plate is not None)))


def _plate_area(frame: FrameSpec, placed: PlacedBoard, eye: Eye) -> Any:
    corners_m = placed.shape.outline_m()
    pieces = _pieces(frame, eye) * max(placed.shape.columns, placed.shape.rows)
    edge_m = _divided(corners_m, np.roll(corners_m, -1, axis=0), pieces).reshape(-1, 3)
    return image_area(frame.rig, eye, placed.left_from_board.apply(edge_m))


def _black_area(frame: FrameSpec, placed: PlacedBoard, eye: Eye) -> shapely.MultiPolygon:
    """Every other square, starting at the lower corner; the squares touch only at the inner corners."""
    corners_m = _black_squares_m(placed.shape)
    edges_m = _divided(corners_m, np.roll(corners_m, -1, axis=1), _pieces(frame, eye))
    areas = [
        image_area(frame.rig, eye, placed.left_from_board.apply(edge_m))
        for edge_m in edges_m.reshape(len(corners_m), -1, 3)
    ]
    return shapely.MultiPolygon([part for area in areas for part in shapely.get_parts(area) if not part.is_empty])


def _black_squares_m(board: CalibrationBoard) -> Array:
    """(S, 4, 3) corners of the black squares, around each. [m]"""
    grid = board.grid_m()
    row, column = np.nonzero(np.indices((board.rows, board.columns)).sum(axis=0) % 2 == 0)
    corners = ((0, 0), (0, 1), (1, 1), (1, 0))
    return np.stack([grid[row + down, column + right] for down, right in corners], axis=1)


def _pieces(frame: FrameSpec, eye: Eye) -> int:
    return 1 if frame.rig.lens(eye) is None else _PIECES_PER_SQUARE


def _divided(start: Array, end: Array, pieces: int) -> Array:
    """(..., pieces, 3) points along the way from (..., 3) starts to ends, without the ends."""
    share: Array = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    points: Array = start[..., None, :] * (1.0 - share) + end[..., None, :] * share
    return points


def _passes(frame: FrameSpec, placed: PlacedBoard, eye: Eye, is_seen: bool) -> PixelPasses:
    """Part id, depth and normal where the rays through the pixel centres meet the plate."""
    passes = empty_passes(frame.rig.camera)
    if not is_seen:
        return passes
    pose, camera = placed.left_from_board, frame.rig.camera
    rays = frame.rig.rays(np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), -1), eye)
    center_m, axis = pose.translation_m - frame.rig.eye_offset_m(eye), pose.rotation[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = (center_m @ axis) / (rays @ axis)
        place_m = (rays * depth_m[..., None] - center_m) @ pose.rotation[:, :2]
        half_m = np.array(placed.shape.size_m) / 2
        met = (depth_m > 0) & (np.abs(place_m) <= half_m).all(axis=-1)
    passes.part_id[met] = int(Part.BOARD)
    passes.depth_m[met] = depth_m[met]
    passes.normal[met] = -axis
    return passes
