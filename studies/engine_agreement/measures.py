"""What two renderings are compared by: centroids, masks and luminance of a frame, illuminance of white plates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import Recipe, RenderSettings, load_recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP, Part, drogue_part_ids
from geometry.circles import disc_area_px2, project_disc_centers
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, Eye
from render.engine import EyeRadiance, RenderEngine, StereoRadiance
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import luminance
from studies.engine_agreement.paired_frames import LAMP_CD_M2, RenderedFrame

_FEWEST_PIXELS = 20
# Margin around a disc's outline, for motion blur and edge pixels.
_REACH_PX = 2.5
# Least share of the light of a whole disc; with less, the lamp is hidden, out, or behind thick mist.
_LEAST_LIGHT = 0.02
MARKERS = "markers"
WHITE = (1.0, 1.0, 1.0)
# Facing the camera, and tilted up, down and sideways.
TILTS_DEG = ((0.0, 0.0), (35.0, 0.0), (-35.0, 0.0), (0.0, 40.0))


@dataclass(frozen=True)
class FrameAgreement:
    """Agreement of two engines on one frame.

    Attributes:
        centroids_px: (M, 3, 2) by marker and eye: the label, and the centroid of the lamp's light by each engine.
        drogue_iou: intersection over union of the drogue's masks, both eyes together.
        rib_distance_px: largest distance of a rib's pixel from the other engine's ribs, 0 without ribs. [px]
        part_sums: by part name: number of pixels, and the sums of luminance over them by each engine. [cd/m2]
    """

    centroids_px: NDArray[np.float64]
    drogue_iou: float
    rib_distance_px: float
    part_sums: dict[str, tuple[int, float, float]]

    def row(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return vars(self) | {"centroids_px": self.centroids_px.tolist()}


def agreement_from_row(row: dict[str, Any]) -> FrameAgreement:
    """The agreement from its `FrameAgreement.row`."""
    return FrameAgreement(
        centroids_px=np.array(row["centroids_px"], dtype=np.float64).reshape(-1, 3, 2),
        drogue_iou=row["drogue_iou"],
        rib_distance_px=row["rib_distance_px"],
        part_sums={name: tuple(sums) for name, sums in row["part_sums"].items()},
    )


def compare_renderings(frame: FrameSpec, one: RenderedFrame, other: RenderedFrame) -> FrameAgreement:
    """Measure how far two engines agree on a frame."""
    assert frame.drogue is not None
    both = [(eye_radiance(one.plain, eye), eye_radiance(other.plain, eye)) for eye in EYES]
    ids = np.stack([[a.part_id, b.part_id] for a, b in both], axis=1)
    drogue = np.isin(ids, drogue_part_ids(frame.drogue.marker_count))
    union = np.count_nonzero(drogue[0] | drogue[1])
    return FrameAgreement(
        centroids_px=np.concatenate([_centroids(frame, one, other, eye) for eye in EYES]),
        drogue_iou=np.count_nonzero(drogue[0] & drogue[1]) / union if union else 1.0,
        rib_distance_px=max(_farthest_px(a.part_id == Part.RIBS, b.part_id == Part.RIBS) for a, b in both),
        part_sums=_part_sums(both),
    )


def eye_radiance(radiance: StereoRadiance, eye: Eye) -> EyeRadiance:
    """Radiance of one eye."""
    return radiance.left if eye == "left" else radiance.right


def _centroids(frame: FrameSpec, one: RenderedFrame, other: RenderedFrame, eye: Eye) -> NDArray[np.float64]:
    """(M, 3, 2) as in `FrameAgreement`, of the markers that both engines show completely."""
    assert frame.drogue is not None and frame.left_from_drogue is not None
    layout = marker_layout(frame.drogue)
    pose = frame.left_from_drogue
    labels = project_disc_centers(frame.rig, pose, layout.centers_m, np.full(layout.count, layout.radius_m), eye)
    images = [
        luminance(eye_radiance(r.lit, eye).radiance_cd_m2 - eye_radiance(r.plain, eye).radiance_cd_m2)
        for r in (one, other)
    ]
    rows = []
    for index, (center_m, label) in enumerate(zip(layout.centers_m, labels, strict=True)):
        area = disc_area_px2(frame.rig, pose, center_m, layout.radius_m, eye)
        reach = 1.1 * float(np.sqrt(area / np.pi)) + _REACH_PX
        if not frame.rig.camera.contains(label, reach) or not _is_whole(one, eye, index):
            continue
        measured = [_centroid(image, label, reach, _LEAST_LIGHT * area) for image in images]
        if measured[0] is not None and measured[1] is not None:
            rows.append([label, measured[0], measured[1]])
    return np.array(rows, dtype=np.float64).reshape(-1, 3, 2)


def _is_whole(rendered: RenderedFrame, eye: Eye, marker: int) -> bool:
    seen = eye_radiance(rendered.plain, eye)
    part = FIRST_MARKER_ID + marker
    amodal = seen.amodal_px.get(part, 0)
    return amodal > 0 and amodal == np.count_nonzero(seen.part_id == part)


def _centroid(
    image: NDArray[np.float64], near_px: NDArray[np.float64], reach_px: float, least_px2: float
) -> NDArray[np.float64] | None:
    u0, v0 = np.floor(near_px - reach_px).astype(int)
    u1, v1 = np.ceil(near_px + reach_px).astype(int) + 1
    v, u = np.mgrid[v0:v1, u0:u1]
    inside = np.hypot(u - near_px[0], v - near_px[1]) <= reach_px
    weight = np.where(inside, image[v0:v1, u0:u1], 0.0) / LAMP_CD_M2
    total = weight.sum()
    return np.array([(weight * u).sum(), (weight * v).sum()]) / total if total > least_px2 else None


def _farthest_px(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Largest distance of a pixel of either mask from the other mask. [px]"""
    if not one.any() or not other.any():
        return 0.0 if one.any() == other.any() else float(np.linalg.norm(one.shape))
    far = 0.0
    for mask, target in ((one, other), (other, one)):
        to_target = cv2.distanceTransform((~target).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        far = max(far, float(to_target[mask].max()))
    return far


def _part_sums(both: list[tuple[EyeRadiance, EyeRadiance]]) -> dict[str, tuple[int, float, float]]:
    """Sums over the pixels in which both engines see the same part; all markers together."""
    sums: dict[str, tuple[int, float, float]] = {}
    for a, b in both:
        values = luminance(a.radiance_cd_m2), luminance(b.radiance_cd_m2)
        for part in np.unique(a.part_id):
            if part == Part.SKY:
                continue
            # Parts of other drogues count with those of the sought one.
            own = int(part) % INSTANCE_STEP
            name = MARKERS if own >= FIRST_MARKER_ID else Part(own).name.lower()
            same = (a.part_id == part) & (b.part_id == part)
            count, one, other = sums.get(name, (0, 0.0, 0.0))
            sums[name] = count + int(same.sum()), one + values[0][same].sum(), other + values[1][same].sum()
    return {name: row for name, row in sums.items() if row[0] >= _FEWEST_PIXELS}


@dataclass(frozen=True)
class PlateIlluminance:
    """Illuminance of one plate by each engine, and by integration over the unobstructed environment. [lux]"""

    pitch_deg: float
    yaw_deg: float
    one_lux: float
    other_lux: float
    integral_lux: float

    @property
    def ratio(self) -> float:
        """First engine's illuminance over the second's."""
        return self.one_lux / self.other_lux


def compare_plate(
    tilt_deg: tuple[float, float], samples: int, one: RenderEngine, other: RenderEngine
) -> PlateIlluminance:
    """Illuminance of the drogue's face, painted white: its radiance is illuminance / pi.

    Args:
        tilt_deg: pitch and yaw of the plate. [deg]
        samples: through each of its pixels.
        one, other: engines.
    """
    frame, settings = plate_frame(samples, tilt_deg)
    got = []
    for engine in (one, other):
        seen = engine.render(frame, settings).left
        inside = (seen.part_id == Part.FACE) & (seen.coverage > 0.999)
        got.append(np.pi * float(luminance(seen.radiance_cd_m2[inside]).mean()))
    assert frame.left_from_drogue is not None
    normal = -(frame.world_from_left @ frame.left_from_drogue).rotation[:, 2]
    integral = luminance(environment_radiance(frame.environment).plate_illuminance_lux(normal))
    return PlateIlluminance(
        pitch_deg=tilt_deg[0],
        yaw_deg=tilt_deg[1],
        one_lux=got[0],
        other_lux=got[1],
        integral_lux=float(integral),
    )


def plate_frame(samples: int, tilt_deg: tuple[float, float]) -> tuple[FrameSpec, RenderSettings]:
    """A frame of the white plate, and how to render it; arguments as `compare_plate`."""
    recipe = _plate_recipe(samples)
    return _tilted(recipe, *tilt_deg), recipe.render


def _plate_recipe(samples: int) -> Recipe:
    recipe = load_recipe("smoke").recipe
    changes = {
        "distance": {"law": "stations", "stations_m": (4.0,)},
        "render": {**recipe.render.model_dump(), "samples_per_px": samples, "surround_samples_per_px": 4},
    }
    return Recipe.model_validate({**recipe.model_dump(), **changes})


def _tilted(recipe: Recipe, pitch_deg: float, yaw_deg: float) -> FrameSpec:
    frame = sample_frame(recipe, 0)
    assert frame.drogue is not None
    drogue = DrogueParameters.model_validate(
        frame.drogue.model_dump() | {"face_reflectance_rgb": WHITE, "marker_reflectance_rgb": WHITE}
    )
    # The sun is behind the cameras, so that nothing shades the plate; the air is clear.
    environment = frame.environment.model_copy(
        update={"sun_azimuth_deg": 190.0, "sun_elevation_deg": 35.0, "visibility_m": 400_000.0}
    )
    rotation = rotation_from_angles(float(np.radians(pitch_deg)), float(np.radians(yaw_deg)), 0.0)
    pose = RigidTransform(rotation, np.array([0.0, 0.0, 4.0]))
    return frame.model_copy(update={"drogue": drogue, "environment": environment, "left_from_drogue": pose})
