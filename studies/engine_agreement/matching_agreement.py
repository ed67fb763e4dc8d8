"""`python -m studies.engine_agreement.matching_agreement`: exported disparity and flow against labels and pixels.

Renders three neighbouring pairs of a docking by each engine, exports them, reads the files with OpenCV and compares
where they send a marker with the label and with the light of the other picture, and every pixel's part id with that of
the pixel where they send it.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import passes_file
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord, ViewRecord
from drogue_models.parts import FIRST_MARKER_ID, Part
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from geometry.stereo import EYES, Eye
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export

# Further keys of `[render]` by engine. Of Blender's edges, sampled as usual, the noise would be all that shows.
ENGINES = {"analytic": "", "mitsuba": "", "blender": "samples_per_px = 64\nedge_samples_per_px = 1296\n"}
FIRST_FRAME, FRAMES = 20, 3
RECIPE = """
name = "dense-matching"
seed = 3
rig = "rgb-ideal"
[frames]
count = 50
[sequence]
frames_per_sequence = 50
frame_rate_hz = 10
[sequence.receiver]
start_m = 4.0
end_m = 1.7
closure_m_s = 1.0
hold_s = 0.0
[outputs]
exr = true
# Light of their own, far above that of face and surroundings, shows the markers' edges and nothing else.
[[target.variants]]
[target.variants.drogue]
name = "lit-8"
marker_luminance_cd_m2 = 1e5
marker_positions_m = [
  [0.27, 0.0], [0.190919, 0.190919], [0.0, 0.27], [-0.190919, 0.190919],
  [-0.27, 0.0], [-0.190919, -0.190919], [0.0, -0.27], [0.190919, -0.190919],
]
"""
_KNOWN_PX = 1e9
# Pixels around a marker that its light reaches and that must show the face, and those that tell the face's own light.
_NEAR, _AROUND = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size_px, size_px)) for size_px in (5, 13))

Displacement = NDArray[np.float64]


class Picture:
    """One eye of one pair, without noise."""

    def __init__(self, dataset: Dataset, frame_index: int, eye: Eye) -> None:
        """Read its record and its passes."""
        self.record: PairRecord = dataset.record(frame_index)
        self.view: ViewRecord = self.record.views.left if eye == "left" else self.record.views.right
        data = dataset.frames.read(frame_index, passes_file(eye))
        planes = read_passes(data, f"frame {frame_index}", self.record.frame.rig.camera)
        self.part = planes["id.X"].astype(np.uint8)
        self.luminance = (0.2126 * planes["R"] + 0.7152 * planes["G"] + 0.0722 * planes["B"]).astype(np.float64)

    @cached_property
    def is_inner(self) -> NDArray[np.bool_]:
        """(H, W) whether all pixels around have the same part id."""
        inner: NDArray[np.bool_] = np.equal(cv2.dilate(self.part, _NEAR), cv2.erode(self.part, _NEAR))
        return inner

    def marker_light(self, index: int) -> NDArray[np.float64] | None:
        """(H, W) light of a marker beyond that of the face, or None where not all of it is seen on the face."""
        marker = self.view.markers[index]
        if not marker.in_image or marker.visible_fraction < 1:
            return None
        own = (self.part == FIRST_MARKER_ID + index).astype(np.uint8)
        near = cv2.dilate(own, _NEAR) > 0
        around = (cv2.dilate(own, _AROUND) > 0) & ~near & (self.part == Part.FACE)
        if not np.isin(self.part[near], (FIRST_MARKER_ID + index, Part.FACE)).all():
            return None
        return np.asarray(np.where(near, self.luminance - np.median(self.luminance[around]), 0.0))


def errors_px(
    first: Picture, second: Picture, shift_px: Displacement, matched: NDArray[np.bool_]
) -> dict[str, list[float]]:
    """Errors of (H, W, 2) displacements from one picture to another, nan where unknown. [px]"""
    found: dict[str, list[float]] = defaultdict(list)
    height, width = matched.shape
    target = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + shift_px
    # Only markers are stretched; beyond them displacements may be unknown.
    stretch = np.abs(np.linalg.det(np.nan_to_num(np.stack(np.gradient(target, axis=(1, 0)), axis=-1))))
    for index, (old, new) in enumerate(zip(first.view.markers, second.view.markers, strict=True)):
        light, other = first.marker_light(index), second.marker_light(index)
        if light is None or other is None:
            continue
        center = np.array(old.center_proj_px)
        predicted = center + bilinear(shift_px, center)
        found["label"].append(float(np.linalg.norm(predicted - new.center_proj_px)))
        # The same light on an area that the displacements stretch.
        here = light != 0
        moved = np.average(target[here], axis=0, weights=(light * stretch)[here])
        v, u = np.nonzero(other)
        seen = np.average(np.column_stack([u, v]), axis=0, weights=other[v, u])
        found["pixels"].append(float(np.linalg.norm(moved - seen)))
    place = np.rint(np.where(matched[..., None], target, 0.0)).astype(int)
    inner = matched & first.is_inner & second.is_inner[place[..., 1], place[..., 0]]
    found["part"] = (first.part != second.part[place[..., 1], place[..., 0]])[inner].astype(float).tolist()
    return found


def bilinear(image: Displacement, at_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) value of a (H, W, 2) image between its pixels, in double precision."""
    u, v = np.floor(at_px).astype(int)
    right, down = at_px - (u, v)
    rows = image[v : v + 2, u : u + 2]
    upper, lower = rows[:, 0] * (1 - right) + rows[:, 1] * right
    return np.asarray(upper * (1 - down) + lower * down)


def flow_errors(dataset: Dataset, exported: Path) -> Iterator[dict[str, list[float]]]:
    """Errors of each file of flow."""
    for eye in EYES:
        pictures = [Picture(dataset, index, eye) for index in dataset.frame_indices]
        for number, (first, second) in enumerate(pairwise(pictures), start=1):
            name = f"sequence_0000_{eye}/frame_{number:04d}"
            flow = cv2.readOpticalFlow(str(exported / "flow" / f"{name}.flo")).astype(np.float64)
            masks = [cv2.imread(str(exported / kind / f"{name}.png"), 0) for kind in ("occlusions", "outofframe")]
            known = np.abs(flow[..., 0]) < _KNOWN_PX
            flow[~known] = np.nan
            yield errors_px(first, second, flow, known & (np.maximum(*masks) == 0))


def disparity_errors(dataset: Dataset, exported: Path) -> Iterator[dict[str, list[float]]]:
    """Errors of each file of disparity."""
    for index in dataset.frame_indices:
        pictures = [Picture(dataset, index, eye) for eye in EYES]
        for number, sign in ((0, -1.0), (1, 1.0)):
            scene = exported / f"{index:06d}"
            disparity = cv2.imread(str(scene / f"disp{number}.pfm"), cv2.IMREAD_UNCHANGED).astype(np.float64)
            shift = np.stack([sign * disparity, np.zeros_like(disparity)], axis=-1)
            matched = cv2.imread(str(scene / f"mask{number}nocc.png"), 0) == 255
            yield errors_px(pictures[number], pictures[1 - number], shift, matched)


def main(
    out: Path,
    engines: Annotated[list[str] | None, typer.Option("--engine", help="only this one; may be repeated")] = None,
) -> None:
    """Render, export and compare; prints a line for each engine and format."""
    if unknown := set(engines or ()) - set(ENGINES):
        raise typer.BadParameter(f"--engine: must be one of {', '.join(ENGINES)}, got {min(unknown)}")
    for engine in engines or ENGINES:
        text = f'{RECIPE}[render]\nengine = "{engine}"\n{ENGINES[engine]}'
        folder, frames = out / engine, range(FIRST_FRAME, FIRST_FRAME + FRAMES)
        render_dataset(
            RecipeSource(parse_recipe(text), text), folder, frames, ExecutionOptions(1), PlainProgress(sys.stderr)
        )
        dataset = Dataset(folder)
        for name, errors in (("sintel", flow_errors), ("middlebury", disparity_errors)):
            exported = out / f"{engine}-{name}"
            if not exported.exists():
                write_export(name, folder, exported, ExportLog())
            found: dict[str, list[float]] = defaultdict(list)
            for one in errors(dataset, exported / "training"):
                for key, values in one.items():
                    found[key] += values
            labels, pixels, parts = (np.array(found[key]) for key in ("label", "pixels", "part"))
            print(
                f"{engine} {name}: {len(labels)} markers, to labels at most {labels.max():.1e} px, to pixels "
                f"{np.sqrt((pixels**2).mean()):.4f} rms and {pixels.max():.4f} px at most; {len(parts)} inner pixels, "
                f"{int(parts.sum())} of another part"
            )


if __name__ == "__main__":
    typer.run(main)
