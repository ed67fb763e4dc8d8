"""Masks of the flat rings, each as if it stood alone: the amodal truth of images that the analytic engine drew."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.stereo import Eye
from render.analytic_engine.flat_parts import FlatDrogue, flat_drogue
from render.analytic_engine.outlines import EyeView
from render.analytic_engine.ring_passes import pixel_passes
from render.surfaces import missing_parts


def flat_part_masks(frame: FrameSpec, eye: Eye) -> dict[int, NDArray[np.bool_]]:
    """(H, W) by part id, the pixel centres whose rays would meet the part's rings if these stood alone.

    Empty for a frame without a drogue.
    """
    if frame.drogue is None or frame.left_from_drogue is None:
        return {}
    view = EyeView(frame.rig, eye, frame.left_from_drogue)
    masks: dict[int, NDArray[np.bool_]] = {}
    for ring in flat_drogue(frame.drogue, missing_parts(frame)).back_to_front:
        alone = pixel_passes(FlatDrogue((), (ring,), ()), view).part_id == ring.part
        masks[ring.part] = masks[ring.part] | alone if ring.part in masks else alone
    return masks
