"""Compares pictures of drawn cameras with photographs, and times them.

`python -m studies.drawn_cameras measure data/world-real ~/photographs`
`python -m studies.drawn_cameras redraw data/cloud --out out/drawn`
`python -m studies.drawn_cameras cost`
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.camera_ranges import CameraRanges
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.layout import MANIFEST_FILE
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.frame import FrameSpec
from droguekit.api.recipe_rendering import load_recipe
from droguekit.scoring.report.label_drawing import display_picture
from render.camera.optics import saturation_cd_m2
from render.camera.sensor import expose
from render.engine import EyeRadiance, StereoRadiance
from scenes.camera_sampling import camera_of_scene
from scenes.sampler import sample_frame
from studies.wrong_input import wrong_input_ends

_PATCH_PX = 16
# The calmest patches of a picture show its noise.
_CALM_SHARE = 0.05
_DARK_LEVEL, _BRIGHT_LEVEL = 16, 250
_BLOCK_PX = 8
# Edges of which sharpness is told: among the steepest of the picture, and of more than so many levels.
_EDGES, _LEAST_STEP = 400, 40
_REACH_PX = 12


@dataclass(frozen=True)
class PictureMeasures:
    """Means over pictures.

    Attributes:
        pictures: how many.
        noise: standard deviation in the calmest twentieth of the patches. [of 255 levels]
        lag_one: correlation of that noise between neighbours; NaN where there is no noise.
        mean: level. [of 255]
        dark_share, bright_share: pixels below 16 and above 250.
        edge_px: distance in which the steepest edges go from a tenth to nine tenths, median; NaN without edges. [px]
        blockiness: mean step across borders of blocks of 8 px over that elsewhere; 1 without blocks.
    """

    pictures: int
    noise: float
    lag_one: float
    mean: float
    dark_share: float
    bright_share: float
    edge_px: float
    blockiness: float


def measure_pictures(pictures: Iterable[NDArray[np.uint8]]) -> PictureMeasures:
    """Means over pictures as they are shown, (H, W, 3) or (H, W).

    Raises:
        ValueError: there are none.
    """
    rows = []
    for picture in pictures:
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        noise, lag_one = calm_noise(grey)
        shares = float((grey < _DARK_LEVEL).mean()), float((grey > _BRIGHT_LEVEL).mean())
        rows.append((noise, lag_one, float(grey.mean()), *shares, edge_width_px(grey), blockiness(grey)))
    if not rows:
        raise ValueError("pictures: there are none to measure")
    table = np.array(rows)
    known = ~np.isnan(table)
    sums, counts = np.where(known, table, 0.0).sum(axis=0), known.sum(axis=0)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    return PictureMeasures(len(rows), *map(float, means))


def calm_noise(grey: NDArray[np.uint8]) -> tuple[float, float]:
    """Standard deviation and lag-one correlation of what is left of the calmest patches after a fitted plane.

    Clipped patches are left out. The choice and the fit take a little of the correlation: white noise gives -0.03.
    """
    height, width = (size // _PATCH_PX * _PATCH_PX for size in grey.shape)
    patches = grey[:height, :width].reshape(height // _PATCH_PX, _PATCH_PX, width // _PATCH_PX, _PATCH_PX)
    patches = patches.transpose(0, 2, 1, 3).reshape(-1, _PATCH_PX, _PATCH_PX).astype(np.float64)
    patches = patches[(patches.min(axis=(1, 2)) > 2) & (patches.max(axis=(1, 2)) < 253)]
    if not len(patches):
        return 0.0, float("nan")
    v, u = np.mgrid[:_PATCH_PX, :_PATCH_PX] - (_PATCH_PX - 1) / 2
    plane = np.stack([np.ones_like(u), u, v], axis=-1).reshape(-1, 3)
    left = patches.reshape(len(patches), -1)
    left = left - left @ plane @ np.linalg.inv(plane.T @ plane) @ plane.T
    order = np.argsort(left.std(axis=1))[: max(1, round(_CALM_SHARE * len(left)))]
    calm = left[order].reshape(-1, _PATCH_PX, _PATCH_PX)
    variance = float((calm**2).mean())
    if variance == 0:
        return 0.0, float("nan")
    return float(np.sqrt(variance)), float((calm[:, :, 1:] * calm[:, :, :-1]).mean() / variance)


def edge_width_px(grey: NDArray[np.uint8]) -> float:
    """Median distance from a tenth to nine tenths of the height of the steepest near-vertical edges. [px]"""
    level = grey.astype(np.float64)
    slope = np.zeros_like(level)
    slope[:, 1:-1] = np.abs(level[:, 2:] - level[:, :-2]) / 2
    slope[:, :_REACH_PX] = slope[:, -_REACH_PX:] = 0
    is_peak = (slope >= np.roll(slope, 1, axis=1)) & (slope > np.roll(slope, -1, axis=1))
    rows, columns = np.nonzero(is_peak & (slope > 8))
    steepest = np.argsort(-slope[rows, columns])[:_EDGES]
    widths = []
    for row, column in zip(rows[steepest], columns[steepest], strict=True):
        profile = level[row, column - _REACH_PX : column + _REACH_PX + 1]
        profile = profile if profile[-1] >= profile[0] else profile[::-1]
        low, high = profile[:4].mean(), profile[-4:].mean()
        if high - low < _LEAST_STEP:
            continue
        share = (profile - low) / (high - low)
        # From the middle of the edge outward, so that texture beside it does not count.
        begins = _crossing(share[: _REACH_PX + 2][::-1], 0.1)
        ends = _crossing(1.0 - share[_REACH_PX - 1 :], 0.1)
        if begins is not None and ends is not None:
            widths.append(begins + ends - 2)
    return float(np.median(widths)) if widths else float("nan")


def _crossing(falling: NDArray[np.float64], level: float) -> float | None:
    """Place at which samples fall below a level, linearly between them; None where they do not."""
    below = np.flatnonzero(falling < level)
    if not len(below) or below[0] == 0:
        return None
    k = int(below[0])
    return float(k - 1 + (falling[k - 1] - level) / (falling[k - 1] - falling[k]))


def blockiness(grey: NDArray[np.uint8]) -> float:
    """Mean step across the borders of blocks of 8 px over the mean step elsewhere."""
    step = np.abs(np.diff(grey.astype(np.float64), axis=1)).mean(axis=0)
    is_border = (np.arange(len(step)) + 1) % _BLOCK_PX == 0
    elsewhere = step[~is_border].mean()
    return float(step[is_border].mean() / elsewhere) if elsewhere > 0 else 1.0


_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_COST_SIZE_PX = (1024, 768)
# What clipped pixels of a linear picture may have been.
_CLIPPED = 1.3


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, draw again, or time."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.drawn_cameras",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    measure = commands.add_parser("measure", help="a line of numbers for each folder")
    measure.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a dataset, or a folder of pictures")
    redraw = commands.add_parser("redraw", help="the left images of a linear dataset as drawn cameras show them")
    redraw.add_argument("dataset", type=Path, metavar="DIR", help="a dataset with linear images")
    redraw.add_argument("--out", type=Path, required=True, metavar="DIR2", help="folder for the pictures")
    cost = commands.add_parser("cost", help="CPU time of an image of 1024 x 768")
    cost.add_argument("--scenes", type=int, default=20, metavar="N", help="cameras to time (default 20)")
    options = parser.parse_args(arguments)
    with wrong_input_ends("drawn_cameras"):
        if options.command == "measure":
            _measure(options.folders)
        elif options.command == "redraw":
            _redraw(Dataset(options.dataset), options.out)
        else:
            _time(options.scenes)


def _measure(folders: Sequence[Path]) -> None:
    print("folder | " + " | ".join(field.name for field in fields(PictureMeasures)))
    for folder in folders:
        found = astuple(measure_pictures(shown_pictures(folder)))
        print(f"{folder.name} | {found[0]} | " + " | ".join(f"{value:.3f}" for value in found[1:]), flush=True)


def shown_pictures(folder: Path) -> Iterator[NDArray[np.uint8]]:
    """Left images of a dataset, on the sRGB curve, or the pictures of a folder.

    Raises:
        ValueError: there are none, or a picture cannot be read; names folder or file.
        OSError: there is no such folder.
    """
    if (folder / MANIFEST_FILE).exists():
        source = Dataset(folder)
        yield from (display_picture(source.images(index)) for index in source.frame_indices)
        return
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _PICTURES)
    if not paths:
        raise ValueError(f"{folder}: has no dataset and no pictures; give a folder with {', '.join(_PICTURES)}")
    for path in paths:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None:
            raise ValueError(f"{path}: is no picture that OpenCV reads")
        yield np.asarray(picture[..., ::-1], dtype=np.uint8)


def _redraw(source: Dataset, out: Path) -> None:
    """Take pixel values for light: what was clipped is a third brighter, and noise and blur are doubled."""
    recipe = source.manifest.recipe
    if recipe.sensor.encoding != "linear":
        raise ValueError(f"{source.path}: its images are not linear, and say less about the light")
    sensor = recipe.sensor.model_copy(update={"encoding": "gamma", "output_bits": 8})
    with_cameras = recipe.model_copy(update={"camera": CameraRanges(), "sensor": sensor})
    out.mkdir(parents=True, exist_ok=True)
    for index in source.frame_indices:
        frame, images = source.record(index).frame, source.images(index)
        scene_sensor, camera = camera_of_scene(with_cameras, frame.scene_id)
        drawn = frame.model_copy(update={"sensor": scene_sensor, "camera": camera})
        span = 2**images.bits - 1 - images.black_level_dn
        level = np.clip((images.left.astype(np.float32) - images.black_level_dn) / span, 0, 1)
        light = np.where(level >= 1.0, np.float32(_CLIPPED), level) * np.float32(saturation_cd_m2(frame))
        picture = expose(drawn, _both_eyes(light.astype(np.float32))).left
        (out / f"{index:06d}.png").write_bytes(encode_png(picture))


def _both_eyes(light: NDArray[np.float32]) -> StereoRadiance:
    """(H, W, 3) light that both eyes see, with nothing in front of the sky. [cd/m2]"""
    nothing = np.zeros(light.shape[:2], np.float32)
    eye = EyeRadiance(
        radiance_cd_m2=light,
        coverage=nothing,
        part_id=nothing.astype(np.uint8),
        depth_m=nothing,
        normal=np.zeros((*nothing.shape, 3), np.float32),
        amodal_px={},
    )
    return StereoRadiance(
        left=eye,
        right=eye,
        engine="a picture",
        engine_version="1",
        monte_carlo_noise_fraction=0.0,
        stage_s={},
    )


def _time(scenes: int) -> None:
    """CPU time of images of smooth noise, with and without drawn cameras; the first pair compiles and is left out."""
    if scenes < 1:
        raise ValueError(f"--scenes: must be at least 1, got {scenes}")
    cv2.setNumThreads(1)
    width, height = _COST_SIZE_PX
    rig = {"preset": "rgb-ideal", "encoding": "gamma", "width_px": width, "height_px": height, "focal_px": 1706.67}
    recipe = load_recipe("world-real", rig=rig, frames={"count": scenes + 1, "scenes": scenes + 1})
    noise = np.random.default_rng(1).random((height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    for name, used in (("drawn cameras", recipe), ("the sensor alone", recipe.model_copy(update={"camera": None}))):
        times_s = [_image_s(sample_frame(used, index), smooth) for index in range(scenes + 1)][1:]
        print(
            f"{name}: {1e3 * np.mean(times_s):.0f} ms an image, median {1e3 * np.median(times_s):.0f}, "
            f"most {1e3 * max(times_s):.0f}",
            flush=True,
        )


def _image_s(frame: FrameSpec, light: NDArray[np.float32]) -> float:
    """CPU time of one image of a pair. [s]"""
    seen = _both_eyes(light * np.float32(saturation_cd_m2(frame)))
    began_s = time.process_time()
    expose(frame, seen)
    return (time.process_time() - began_s) / 2


if __name__ == "__main__":
    main()
