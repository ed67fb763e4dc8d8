from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.obstacles import ObstacleShape
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye
from labelgen.disc_images import DiscInEye, marker_discs
from labelgen.export.annotations.part_masks import write_masks
from labelgen.export.export_log import ExportLog
from labelgen.frame_labels import label_frame
from labelgen.part_pixels import parts_mask
from labelgen.segmentation_masks import OCCLUDERS, amodal_masks, named_parts, part_triangles, silhouette, union_of_masks
from render.analytic_engine.analytic_engine import AnalyticEngine
from render.camera.sensor import expose
from render.engine import load_engine
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import Pair
from tests.support.recipe_builder import RIG_160_PX, RecipeTable, Section, build_recipe, stations

BASE: RecipeTable = {
    "name": "masks",
    "seed": 4,
    "rig": {"preset": "rgb-ideal", "width_px": 40, "height_px": 30, "focal_px": 66.0},
    "frames": {"count": 1},
    "distance": stations(2.5),
    "render": {"engine": "analytic"},
}
LENSES = {"k1": -0.3, "k2": 0.05, "principal_point_px": 0.5, "right_rotation_deg": 0.3}


def small_frame(
    eyes: Section | None = None, focal_px: float = 66.0, distance_m: float = 2.5
) -> tuple[Recipe, FrameSpec]:
    recipe = build_recipe(BASE, rig={"focal_px": focal_px, "eyes": eyes}, distance=stations(distance_m))
    return recipe, sample_frame(recipe, 0)


def rays_that_meet(frame: FrameSpec, eye: Eye, triangles: np.ndarray) -> np.ndarray:
    """(H, W) whether rays through pixel centres meet triangles, by Moeller and Trumbore's test of each with each."""
    camera = frame.rig.camera
    pixels = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), -1)
    rays = frame.rig.rays(pixels, eye).reshape(-1, 3)
    met = np.zeros(len(rays), dtype=bool)
    for corner, one, two in triangles:
        edge, other = one - corner, two - corner
        volume, side = np.cross(rays, other) @ edge, np.cross(-corner, edge)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, distance = np.cross(rays, other) @ -corner / volume, rays @ side / volume, other @ side / volume
            met |= (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return met.reshape(camera.height_px, camera.width_px)


# The tanker leaves the image, and lenses bend its long edges by pixels.
@pytest.mark.parametrize("eyes", [None, LENSES])
def test_silhouettes_are_what_rays_meet(eyes: dict[str, float] | None) -> None:
    _, frame = small_frame(eyes)
    parts = part_triangles(frame, "right")
    for part in (Part.CANOPY, Part.TANKER, FIRST_MARKER_ID):
        found, want = silhouette(parts[part], frame.rig, "right"), rays_that_meet(frame, "right", parts[part])
        assert want.any()
        # Rays exactly on an edge, and the 3e-3 px by which pieces of a bent edge are off.
        assert np.count_nonzero(found != want) <= 1


def test_what_reaches_behind_the_camera_is_cut() -> None:
    _, frame = small_frame(LENSES)
    probe = Obstacle(
        kind="probe",
        shape=ObstacleShape(form="probe", radius_m=0.04, length_m=6.0),
        left_from_object=RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.1, 1.0])),
        reflectance_rgb=(0.5, 0.5, 0.5),
    )
    frame = frame.model_copy(update={"bystanders": (probe,)})
    corners = part_triangles(frame, "left")[Part.PROBE]
    assert corners[..., 2].min() < -1 and corners[..., 2].max() > 0.9
    found, want = silhouette(corners, frame.rig, "left"), rays_that_meet(frame, "left", corners)
    assert want.any() and np.count_nonzero(found != want) <= 1


def test_amodal_masks_have_the_records_pixels(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        for eye in EYES:
            seen = getattr(pair.radiance, eye)
            alone = amodal_masks(pair.record, eye, seen.part_id)
            for part, count in seen.amodal_px.items():
                # Counted by another rasterizer; a centre on an edge to the last bit may be decided either way.
                assert abs(np.count_nonzero(alone[part]) - count) <= 1


@pytest.mark.parametrize("eyes", [None, LENSES])
def test_amodal_masks_of_flat_rings_have_the_engines_pixels(eyes: dict[str, float] | None) -> None:
    recipe, frame = small_frame(eyes)
    radiance = AnalyticEngine().render(frame, recipe.render)
    record = label_frame(frame, radiance, expose(frame, radiance))
    for eye in EYES:
        seen = getattr(radiance, eye)
        alone = amodal_masks(record, eye, seen.part_id)
        counts = {part: np.count_nonzero(mask) for part, mask in alone.items()}
        assert counts | seen.amodal_px == counts and len(seen.amodal_px) == 9


def test_masks_divide_the_image(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        part_id = pair.radiance.left.part_id
        alone = amodal_masks(pair.record, "left", part_id)
        named = named_parts(pair.record)
        single = [parts_mask(part_id, parts) for name, parts in named.items() if name != "drogue"]
        np.testing.assert_array_equal(np.sum(single, axis=0), part_id != Part.SKY)
        np.testing.assert_array_equal(
            parts_mask(part_id, named["drogue"]), union_of_masks(alone, named["drogue"], part_id.shape) & (part_id > 0)
        )
        for parts in named.values():
            assert not (parts_mask(part_id, parts) & ~union_of_masks(alone, parts, part_id.shape)).any()
        assert named["occluder"] == OCCLUDERS and {"rim", "canopy", "hub", "hose", "tanker", "marker_7"} <= set(named)


def test_mask_files_are_read_by_opencv(small_dataset: Path, full_pairs: list[Pair], tmp_path: Path) -> None:
    write_masks(small_dataset, tmp_path / "masks", ExportLog())
    for pair in full_pairs:
        folder = tmp_path / "masks" / f"{pair.frame.frame_index:06d}"
        mask = cv2.imread(str(folder / "right_marker_2_visible.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask == 255, pair.radiance.right.part_id == FIRST_MARKER_ID + 2)
        whole = cv2.imread(str(folder / "right_drogue_amodal.png"), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(whole)) == {0, 255}
        assert not (folder / "left_occluder_visible.png").exists()


def lattice_sd_px(disc: DiscInEye) -> float:
    """Standard deviation of the number of pixel centres in an ellipse.

    Source: variance 0.0728 times the perimeter for an outline that lies anyhow on the lattice (Kendall 1948, "On the
    number of lattice points inside a random oval": 0.4577 r for a circle); Ramanujan's perimeter.
    """
    a, b = disc.semi_axes_px()
    h = ((a - b) / (a + b)) ** 2
    return np.sqrt(0.4577 / (2 * np.pi) * np.pi * (a + b) * (1 + 3 * h / (10 + np.sqrt(4 - 3 * h))))


def supersampled_px(frame: FrameSpec, disc: DiscInEye, eye: Eye) -> float:
    """Area of a marker's image by 16 x 16 rays a pixel, written apart from engines and labels. [px]"""
    camera = frame.rig.camera
    u_low, v_low, u_high, v_high = disc.extent_px()
    sub = (np.arange(16) + 0.5) / 16 - 0.5
    u = (np.arange(int(u_low) - 1, int(u_high) + 3)[:, None] + sub).ravel()
    v = (np.arange(int(v_low) - 1, int(v_high) + 3)[:, None] + sub).ravel()
    x, y = (u - camera.cx_px) / camera.fx_px, (v[:, None] - camera.cy_px) / camera.fy_px
    (tx, ty, tz), (nx, ny, nz) = disc.center_m, disc.normal
    z = (tx * nx + ty * ny + tz * nz) / (x * nx + y * ny + nz)
    inside = (x * z - tx) ** 2 + (y * z - ty) ** 2 + (z - tz) ** 2 <= disc.radius_m**2
    return np.count_nonzero(inside) / 256


def test_pixel_centres_count_what_supersampling_counts() -> None:
    rig = {"width_px": 1280, "height_px": 960, "focal_px": 2133.0}
    recipe = build_recipe(BASE, rig=rig, frames={"count": 4}, distance=stations(4.0, 5.5, 7.0, 9.0))
    ratios = []
    for index in range(4):
        frame = sample_frame(recipe, index)
        seen = AnalyticEngine().render(frame, recipe.render)
        for eye in EYES:
            part_id = getattr(seen, eye).part_id
            for disc in marker_discs(marker_layout(frame.drogue), frame.rig, frame.left_from_drogue, eye):
                area_px = supersampled_px(frame, disc, eye)
                count = np.count_nonzero(part_id == disc.part)
                # Of 64 draws the largest is expected at 2.7 standard deviations; 4 are asked for.
                assert abs(count - area_px) < 4 * lattice_sd_px(disc)
                ratios.append(count / area_px)
    # Single ratios spread by 0.4 %; the mean of 64 by 0.05 %: twice that.
    assert abs(np.mean(ratios) - 1) < 1e-3


@pytest.mark.mitsuba
@pytest.mark.parametrize("eyes", [None, LENSES])
def test_silhouettes_are_the_path_tracer_s(eyes: dict[str, float] | None) -> None:
    """Another program's rays through the same pixel centres: part ids, and what it counts of features alone."""
    render = {"engine": "mitsuba", "samples_per_px": 1, "open_samples_per_px": 1, "surround_samples_per_px": 1}
    light = {"edge_samples_per_px": 1, "max_depth": 2, "denoise": False}
    recipe = build_recipe(BASE, rig={**RIG_160_PX, "eyes": eyes}, render=render | light)
    frame = sample_frame(recipe, 0)
    radiance = load_engine("mitsuba").render(frame, recipe.render)
    for eye in EYES:
        seen = getattr(radiance, eye)
        alone = {part: silhouette(corners, frame.rig, eye) for part, corners in part_triangles(frame, eye).items()}
        union = np.any(list(alone.values()), axis=0)
        # Its rays are of float32: a thousandth of the outline's pixels may be decided otherwise.
        assert np.count_nonzero(union != (seen.part_id > 0)) <= 2
        assert len(seen.amodal_px) == 9
        for part, count in seen.amodal_px.items():
            assert abs(np.count_nonzero(alone[part]) - count) <= 1
