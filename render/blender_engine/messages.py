"""What the engine and Blender's process tell each other: plain arrays, made here, drawn there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# The three pictures of a frame: light on everything, what the pixel centres meet, and the same with features alone.
LIGHT, PASSES, FEATURES = "light", "passes", "features"
NORMAL_PASS = "face_normal"
# Cycles sends the first sample of every pixel through the pixel's centre, and only the others to random places in its
# box: the first one is what passes of pixel centres need, and would favour what lies at the centre in light.
CENTER_SAMPLE = 0
FIRST_RANDOM_SAMPLE = 1


@dataclass(frozen=True, eq=False)
class PartMesh:
    """One thing as Blender shall draw it, in the stage's axes.

    Attributes:
        part_id: `drogue_models.parts`.
        vertices_m: (V, 3) float32. [m]
        faces: (F, 3) int32, counter-clockwise seen from outside.
        smooth: whether normals are interpolated over the faces.
        map_places: (V, 2) float32 places in the reflectance map, 0 to 1 from its first column and row, or None.
    """

    part_id: int
    vertices_m: NDArray[np.float32]
    faces: NDArray[np.int32]
    smooth: bool
    map_places: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class Look:
    """What a thing's surface sends back and gives off.

    Attributes:
        reflectance: (3,) diffuse reflectance, or (h, w, 3) of it as a map.
        emission_cd_m2: (3,) radiance of its own. [cd/m2]
        sheen: share of the light that microfacets mirror, and their roughness; None for matt paint.
    """

    reflectance: NDArray[np.floating[Any]]
    emission_cd_m2: NDArray[np.float64]
    sheen: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class StageThings:
    """All that stands on the stage, by name.

    Attributes:
        things: in light.
        features: the visible faces of markers and hub alone, for their amodal pixels.
    """

    things: dict[str, PartMesh]
    features: dict[str, PartMesh]


@dataclass(frozen=True, eq=False)
class Light:
    """Sky, and sun or moon.

    Attributes:
        sky: (H, 2H, 3) map: row 0 is the zenith, column 0 looks along +x, the next ones turn towards +y. [unit]
        world_from_stage: (3, 3) rotation.
        to_sun: (3,) direction in the stage's axes.
        sun: (3,) illuminance of a facing plane. [unit times sr]
        unit_cd_m2: the radiance that Blender's numbers count in, so that they stay near 1 by day and night. [cd/m2]
    """

    sky: NDArray[np.float32]
    world_from_stage: NDArray[np.float64]
    to_sun: NDArray[np.float64]
    sun: NDArray[np.float64]
    unit_cd_m2: float


@dataclass(frozen=True, eq=False)
class FrameSetup:
    """What is set up once for all pictures of a frame.

    Attributes:
        stage: its things, or None when they are those of the last frame.
        moved_m: (V, 3) vertices of those that have moved against the stage, by name. [m]
        looks: of all things, by name.
        light: sky and sun.
    """

    stage: StageThings | None
    moved_m: dict[str, NDArray[np.float32]]
    looks: dict[str, Look]
    light: Light


@dataclass(frozen=True, eq=False)
class CameraPath:
    """One eye over the exposure, with Blender's axes (x right, y up, z backward).

    Attributes:
        positions_m: (K, 3) in the stage's axes at K = 1, or K = 5 equally spaced moments from opening to closing. [m]
        quaternions: (K, 4) `stage_from_camera`, scalar first, neighbours in the same half of the sphere.
    """

    positions_m: NDArray[np.float64]
    quaternions: NDArray[np.float64]


@dataclass(frozen=True)
class RealEye:
    """An eye that is no pinhole with square pixels.

    Attributes:
        focal_px: of either axis. [px]
        distortion: k1, k2, p1, p2, k3, see `geometry.distortion`.
        ideal_from_real: (9,) rows of the rotation from its axes to the rig's.
    """

    focal_px: tuple[float, float]
    distortion: tuple[float, ...]
    ideal_from_real: tuple[float, ...]


@dataclass(frozen=True)
class Window:
    """The part of the image that a picture covers, as a camera of its own.

    Attributes:
        left_px, top_px, width_px, height_px: in the whole image. [px]
        focal_px: of both axes of a pinhole. [px]
        center_px: principal point in the whole image, (0, 0) the centre of the top-left pixel. [px]
        eye: how it differs from a pinhole with square pixels, or None. Blender's depth then is along the ray.
    """

    left_px: int
    top_px: int
    width_px: int
    height_px: int
    focal_px: float
    center_px: tuple[float, float]
    eye: RealEye | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """One rendering.

    Attributes:
        kind: `LIGHT`, `PASSES` or `FEATURES`.
        window: what of the image.
        path: the camera; one moment unless something moves.
        samples: first and number of this picture's samples in the pixels' sequence.
        bounces: how often light may be thrown on after the first surface.
        seed: of the sequence.
        file: where it is written, without `.exr`.
    """

    kind: str
    window: Window
    path: CameraPath
    samples: tuple[int, int]
    bounces: int
    seed: int
    file: str
