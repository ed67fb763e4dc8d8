"""Messages from the engine to Blender's process: plain arrays, made by the engine, rendered by the process.

The process may run on another Python with another numpy: this module needs numpy and the standard library alone.
"""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Kinds of pictures: radiance of everything, passes of the pixel centres, and the same passes with features alone.
LIGHT, PASSES, FEATURES = "light", "passes", "features"
NORMAL_PASS = "face_normal"
# Cycles sends the first sample of a pixel through its centre, and only the others to random places in its box. Passes
# of pixel centres need the first sample; in radiance it would favour what lies at the centre.
CENTER_SAMPLE = 0
FIRST_RANDOM_SAMPLE = 1


@dataclass(frozen=True, eq=False)
class PartMesh:
    """The mesh of one object, in the stage's axes.

    Attributes:
        part_id: `drogue_models.parts`.
        vertices_m: (V, 3) float32. [m]
        faces: (F, 3) int32, counter-clockwise seen from outside.
        smooth: whether normals are interpolated over the faces.
        map_uv: (V, 2) float32 texture coordinates, 0 to 1 from first column and row of the reflectance map, or None.
        normals: (V, 3) float32 unit normals to interpolate, or None for those of the faces around each vertex.
        flies_with_camera: whether it keeps its place in the camera's axes while the shutter is open.
    """

    part_id: int
    vertices_m: NDArray[np.float32]
    faces: NDArray[np.int32]
    smooth: bool
    map_uv: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    flies_with_camera: bool = False


@dataclass(frozen=True, eq=False)
class MovedMesh:
    """New vertices of an object, whose faces stay; attributes as in `PartMesh`."""

    vertices_m: NDArray[np.float32]
    map_uv: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class SurfaceAppearance:
    """What the surface of an object reflects and emits.

    Attributes:
        reflectance: (3,) diffuse reflectance, or (h, w, 3) of it as a map; None where it is as it was.
        emission_cd_m2: (3,) emitted radiance. [cd/m2]
        sheen: share of the light that microfacets reflect, and their roughness; None for matt paint.
        lights_others: whether paths from other surfaces find what it emits, or camera rays only.
    """

    reflectance: NDArray[np.floating[Any]] | None
    emission_cd_m2: NDArray[np.float64]
    sheen: tuple[float, float] | None = None
    lights_others: bool = True


@dataclass(frozen=True, eq=False)
class StageObjects:
    """All objects on the stage, by name.

    Attributes:
        objects: of the lit scene.
        features: the visible faces of markers and hub alone, for their amodal pixel counts.
    """

    objects: dict[str, PartMesh]
    features: dict[str, PartMesh]


@dataclass(frozen=True, eq=False)
class StageLight:
    """Sky, and sun or moon, as lights of the stage.

    Attributes:
        sky: (H, 2H, 3) map: row 0 is the zenith, column 0 looks along +x, the next ones turn towards +y. [unit]
        world_from_stage_rad: (3,) rotation as angles about the fixed axes x, y and z, in this order. [rad]
        stage_from_sun: (4,) quaternion, scalar first, that turns +z to the sun.
        sun: (3,) illuminance of a plane that faces it. [unit times sr]
        unit_cd_m2: the radiance that Blender's numbers count in, so that they stay near 1 by day and night. [cd/m2]
    """

    sky: NDArray[np.float32]
    world_from_stage_rad: NDArray[np.float64]
    stage_from_sun: NDArray[np.float64]
    sun: NDArray[np.float64]
    unit_cd_m2: float


@dataclass(frozen=True, eq=False)
class FrameSetup:
    """What all pictures of a frame share.

    Attributes:
        stage: the objects, or None when they are those of the last frame.
        moved: vertices of the objects that move on the stage, by name.
        appearances: of all objects, by name.
        light: sky and sun.
    """

    stage: StageObjects | None
    moved: dict[str, MovedMesh]
    appearances: dict[str, SurfaceAppearance]
    light: StageLight


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
class DistortedEye:
    """An eye that is not a pinhole with square pixels: its lens distorts.

    Attributes:
        focal_px: of either axis. [px]
        distortion: k1, k2, p1, p2, k3, see `geometry.distortion`.
        ideal_from_real: (9,) rows of the rotation from its axes to the rig's.
    """

    focal_px: tuple[float, float]
    distortion: tuple[float, ...]
    ideal_from_real: tuple[float, ...]


@dataclass(frozen=True)
class ImageWindow:
    """A part of an eye's image, rendered by a camera of its own.

    Attributes:
        left_px, top_px, width_px, height_px: in the whole image. [px]
        focal_px: focal length, the same for both axes of a pinhole. [px]
        center_px: principal point in the whole image, (0, 0) the centre of the top-left pixel. [px]
        eye: its lens, or None for a pinhole with square pixels. With a lens, Blender's depth is along the ray.
    """

    left_px: int
    top_px: int
    width_px: int
    height_px: int
    focal_px: float
    center_px: tuple[float, float]
    eye: DistortedEye | None = None


@dataclass(frozen=True, eq=False)
class PictureRequest:
    """One picture to render.

    Attributes:
        kind: `LIGHT`, `PASSES` or `FEATURES`.
        window: part of the image.
        path: the camera; one moment unless something moves.
        samples: first sample of the pixels' sequence to take, and how many.
        bounces: how many surfaces after the first may reflect light.
        seed: of the sequence.
        file: path of the result, without `.exr`.
    """

    kind: str
    window: ImageWindow
    path: CameraPath
    samples: tuple[int, int]
    bounces: int
    seed: int
    file: str


class _PlainPickler(pickle.Pickler):
    """Writes numbers as their bytes: the names that numpy's own pickles hold differ between numpy 1 and 2."""

    def reducer_override(self, item: Any) -> Any:
        """How an array or one of its numbers is written; all else as usual."""
        if isinstance(item, np.ndarray | np.generic):
            return _numbers, (item.dtype.str, item.shape, item.tobytes())
        return NotImplemented


def _numbers(dtype: str, shape: tuple[int, ...], data: bytes) -> Any:
    return np.frombuffer(data, dtype=dtype).reshape(shape).copy()[()]


def pickled(request: FrameSetup | PictureRequest) -> bytes:
    """A request as a pickle that any numpy from 1.26 on reads."""
    file = io.BytesIO()
    _PlainPickler(file).dump(request)
    return file.getvalue()
