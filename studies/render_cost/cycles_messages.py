"""What both sides of Blender's process share: requests, and the clock for CPU time."""

from __future__ import annotations

import os
from dataclasses import dataclass

from render.blender_engine.messages import CameraPath, FrameSetup, ImageWindow


@dataclass(frozen=True, eq=False)
class DenoisedPicture:
    """One denoised picture of one eye.

    Attributes:
        window: part of the image, as a camera of its own.
        path: the camera at one moment.
        samples: paths per pixel.
        bounces: how many surfaces after the first may reflect light.
        seed: of the samples.
        file: path of the result, without `.exr`.
    """

    window: ImageWindow
    path: CameraPath
    samples: int
    bounces: int
    seed: int
    file: str


@dataclass(frozen=True, eq=False)
class CyclesRequest:
    """A scene, and the pictures to render of it one after the other."""

    setup: FrameSetup
    pictures: tuple[DenoisedPicture, ...]


def cpu_seconds() -> float:
    """User and system time of this process and of its children that have ended. [s]"""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
