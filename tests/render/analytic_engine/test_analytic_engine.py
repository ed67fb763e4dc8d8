"""The analytic engine against closed forms, against areas cut pixel by pixel, and against the path-traced passes."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.special import j1

from datasets_manifest.recipe.recipe import Recipe, RecipeSource, load_recipe
from datasets_manifest.types.field_types import Range
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import HubParameters
from drogue_models.parts import FIRST_MARKER_ID, Part
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from geometry.circles import disc_area_px2
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES
from labelgen.disc_images import DiscInEye, hub_discs, marker_discs
from labelgen.frame_labels import label_frame
from labelgen.validation.dataset_checks import validate_dataset
from labelgen.validation.label_checks import check_against_passes
from render.analytic_engine.analytic_engine import AnalyticEngine
from render.analytic_engine.pixel_coverage import pixel_coverage
from render.camera.sensor import expose
from render.engine import RenderEngine, load_engine
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import paper_view_recipe

LAMP_CD_M2 = 1e6
STATIONS_M = (2.0, 5.0, 10.0, 20.0, 40.0)
# Largest sum of the terms in `lattice_centroid`, times the half-extent to the power of 1.5: 1 / pi^3 for the first one.
LATTICE_LAW = 0.04
PASSES = ("radiance_cd_m2", "coverage", "part_id", "depth_m", "normal")


@pytest.fixture(scope="module")
def analytic() -> RenderEngine:
    return load_engine("analytic")


def with_drogue(frame: FrameSpec, **changes: HubParameters | float | None) -> FrameSpec:
    return frame.model_copy(update={"drogue": frame.drogue.model_copy(update=changes)})


def clear_fraction(frame: FrameSpec, center_m: np.ndarray) -> float:
    """What the air lets through from a place of the drogue."""
    drogue_m = frame.left_from_drogue.translation_m
    slant = np.linalg.norm(drogue_m) / drogue_m[2]
    return np.exp(-frame.environment.extinction_per_m * slant * frame.left_from_drogue.apply(center_m)[2])


def difference(analytic: AnalyticEngine, recipe: Recipe, bright: FrameSpec, dark: FrameSpec) -> dict[str, np.ndarray]:
    """Luminance of one frame less another's, by eye."""
    on, off = (analytic.render(frame, recipe.render) for frame in (bright, dark))
    return {
        eye: (getattr(on, eye).radiance_cd_m2.astype(np.float64) - getattr(off, eye).radiance_cd_m2) @ REC709_LUMINANCE
        for eye in EYES
    }


def lamp_coverage(analytic: AnalyticEngine, recipe: Recipe, frame: FrameSpec) -> dict[str, np.ndarray]:
    """Coverage by all markers: the light of lamps alone over their luminance."""
    images = difference(analytic, recipe, with_drogue(frame, marker_luminance_cd_m2=LAMP_CD_M2), frame)
    return {eye: image / LAMP_CD_M2 for eye, image in images.items()}


def lattice_centroid(disc: DiscInEye) -> tuple[np.ndarray, np.ndarray]:
    """Centroid of the box-averaged image of a disc on the pixel lattice; not quite the centre of its ellipse.

    Within a pixel on the edge the light does not lie in the middle. By Poisson's summation formula, along each axis
    with centre c and half-extent w of the ellipse, the centroid is
    `c + sum_k (-1)^k sin(2 pi k c) J1(2 pi k w) / (pi^2 k^2 w)`. The sum is below 0.04 w^-1.5: 0.009 px at w = 2.7 px.
    """
    u_low, v_low, u_high, v_high = disc.extent_px()
    low, high = np.array([u_low, v_low]), np.array([u_high, v_high])
    center, half = (low + high) / 2, (high - low) / 2
    # Terms fall as k^-2.5: those left out sum up to below 1e-7 px.
    k = np.arange(1, 2001)[:, None]
    terms = (-1.0) ** k * np.sin(2 * np.pi * k * center) * j1(2 * np.pi * k * half) / (np.pi**2 * k**2 * half)
    return center, center + terms.sum(axis=0)


def window(disc: DiscInEye, margin_px: float) -> tuple[slice, slice]:
    """Rows and columns of the pixels around a disc's image."""
    u_low, v_low, u_high, v_high = disc.extent_px()
    rows = slice(int(v_low - margin_px), int(v_high + margin_px) + 2)
    return rows, slice(int(u_low - margin_px), int(u_high + margin_px) + 2)


def area_and_centroid(coverage: np.ndarray, disc: DiscInEye, margin_px: float = 2.5) -> tuple[float, np.ndarray]:
    """Of what lies within `margin_px` of a disc's ellipse."""
    rows, columns = window(disc, margin_px)
    v, u = np.mgrid[rows, columns]
    pixels = np.stack([u, v], axis=-1)
    near = disc.distance_m(pixels) < disc.radius_m * (1 + margin_px / disc.semi_axes_px()[1])
    weight = np.where(near, coverage[rows, columns], 0.0)
    return weight.sum(), (weight[..., None] * pixels).sum(axis=(0, 1)) / weight.sum()


@pytest.mark.parametrize("station", range(len(STATIONS_M)))
def test_area_and_centroid_of_every_marker(analytic: AnalyticEngine, station: int) -> None:
    recipe = paper_view_recipe(stations_m=STATIONS_M)
    frame = sample_frame(recipe, station)
    layout = marker_layout(frame.drogue)
    coverage = lamp_coverage(analytic, recipe, frame)
    for eye in EYES:
        for center_m, disc in zip(
            layout.centers_m, marker_discs(layout, recipe.rig, frame.left_from_drogue, eye), strict=True
        ):
            area, centroid = area_and_centroid(coverage[eye] / clear_fraction(frame, center_m), disc)
            truth = disc_area_px2(recipe.rig, frame.left_from_drogue, center_m, layout.radius_m, eye)
            # Polygons have the disc's area; float32 radiance rounds each pixel by 6e-8 of the lamp.
            assert area == pytest.approx(truth, rel=1e-6)
            ellipse, expected = lattice_centroid(disc)
            # Polygons stand 1e-4 px off the ellipse, evenly around; float32 as above.
            np.testing.assert_allclose(centroid, expected, atol=1e-6)
            # The bar for pixel boxes as they are: the sum above is below LATTICE_LAW w^-1.5 in each axis.
            assert np.abs(centroid - ellipse).max() <= LATTICE_LAW * disc.semi_axes_px()[1] ** -1.5


def test_both_edges_of_the_hub_have_their_own_centres(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(stations_m=(2.0,))
    tilted = RigidTransform(rotation_from_angles(0.15, -0.12, 0.1), np.array([0.05, 0.01, 2.1]))
    frame = sample_frame(recipe, 0).model_copy(update={"left_from_drogue": tilted})
    hubs = [frame.drogue.hub.model_copy(update={"reflectance_rgb": (level,) * 3}) for level in (1.0, 0.0)]
    images = difference(analytic, recipe, *(with_drogue(frame, hub=hub) for hub in hubs))
    layout = marker_layout(frame.drogue)
    for eye in EYES:
        outer, inner = hub_discs(layout, recipe.rig, tilted, eye)
        hub = images[eye] / images[eye].max()
        v, u = np.indices(hub.shape)
        hole = np.where(inner.distance_m(np.stack([u, v], axis=-1)) < 0.06, 1.0 - hub, 0.0)
        for disc, filled in ((inner, hole), (outer, hub + hole)):
            area, centroid = area_and_centroid(filled, disc)
            want = disc_area_px2(recipe.rig, tilted, layout.hub_center_m, disc.radius_m, eye)
            # float32 radiance, as above.
            assert area == pytest.approx(want, rel=1e-6)
            np.testing.assert_allclose(centroid, lattice_centroid(disc)[1], atol=1e-6)
        apart = np.array(lattice_centroid(outer)[0]) - lattice_centroid(inner)[0]
        assert np.hypot(*apart) > 0.1


def test_coverage_is_the_area_cut_by_each_pixel() -> None:
    """Random polygons with a hole, partly beyond the image, against shapely's intersection with every pixel's box."""
    rng = np.random.default_rng(7)
    for _ in range(6):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 40))
        reach = rng.uniform(5, 9, 40)
        outline = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * reach[:, None] + rng.uniform(0, 14, 2)
        center = outline.mean(axis=0)
        area = shapely.Polygon(outline).difference(shapely.Point(center).buffer(1.7))
        pixels = [[shapely.box(u - 0.5, v - 0.5, u + 0.5, v + 0.5) for u in range(14)] for v in range(11)]
        want = shapely.area(shapely.intersection(np.array(pixels), area))
        covered = pixel_coverage([area], 14, 11)
        got = np.zeros((11, 14))
        got[covered.rows, covered.columns] = covered.share
        # Both sum some hundred products of numbers around 10 in float64; shares below 1e-9 count as none.
        np.testing.assert_allclose(got, want, atol=2e-9)


def test_coverage_of_whole_pixels_and_of_nothing() -> None:
    covered = pixel_coverage([shapely.box(1.5, 0.5, 3.5, 2.5)], 8, 6)
    assert (covered.rows, covered.columns) == (slice(1, 3), slice(2, 4))
    assert np.array_equal(covered.share, np.ones((2, 2)))
    assert pixel_coverage([shapely.box(20, 20, 30, 30)], 8, 6) is None
    assert pixel_coverage([shapely.box(-0.5, 1.0, -3.5, 2.0)], 8, 6) is None


def test_parts_are_flat_and_shine_as_their_irradiance_says(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(stations_m=(2.5,))
    frame = sample_frame(recipe, 0)
    seen = analytic.render(frame, recipe.render).left
    around = environment_radiance(frame.environment)
    plate = around.plate_illuminance_lux(-(frame.world_from_left @ frame.left_from_drogue).rotation[:, 2])
    drogue, layout = frame.drogue, marker_layout(frame.drogue)
    features = [(int(Part.HUB), drogue.hub.reflectance_rgb, layout.hub_center_m)]
    features += [
        (FIRST_MARKER_ID + index, drogue.marker_reflectance_rgb, center)
        for index, center in enumerate(layout.centers_m)
    ]
    for part, reflectance, center_m in features:
        mask = seen.part_id == part
        # One pixel inside every edge.
        deep = mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
        deep &= mask[:-2, :-2] & mask[2:, 2:] & mask[:-2, 2:] & mask[2:, :-2]
        values = np.unique(seen.radiance_cd_m2[1:-1, 1:-1][deep], axis=0)
        assert len(values) == 1
        clear = clear_fraction(frame, center_m)
        drogue_m = frame.left_from_drogue.translation_m
        air = around.airlight(frame.world_from_left.rotate(drogue_m / np.linalg.norm(drogue_m)))
        want = np.array(reflectance) * plate / np.pi * clear + air * (1 - clear)
        # float32.
        np.testing.assert_allclose(values[0], want, rtol=1e-6)


def test_coverage_and_surroundings_make_the_whole_image(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(3.0,))
    frame = sample_frame(recipe, 0)
    drawn = analytic.render(frame, recipe.render).right
    empty = analytic.render(frame.model_copy(update={"drogue": None, "left_from_drogue": None}), recipe.render).right
    assert not empty.coverage.any() and not empty.part_id.any() and empty.amodal_px == {}
    assert np.isinf(empty.depth_m).all()
    untouched = drawn.coverage == 0
    assert np.array_equal(drawn.radiance_cd_m2[untouched], empty.radiance_cd_m2[untouched])
    # float32 sums of two areas.
    assert drawn.coverage.min() >= 0 and drawn.coverage.max() <= 1 + 1e-6
    # A pixel centre inside a part whose pixel is not covered, or the other way round, would be a slip of half a pixel.
    assert drawn.coverage[drawn.part_id != Part.SKY].min() > 0.3
    assert drawn.coverage[drawn.part_id == Part.SKY].max() < 0.7


@pytest.mark.mitsuba
@pytest.mark.parametrize("angles_rad", [(0.0, 0.0, 0.0), (0.15, -0.12, 0.3), (0.0, 0.85, 0.0)])
def test_part_ids_agree_with_the_path_traced_ones(
    analytic: AnalyticEngine, engine: RenderEngine, angles_rad: tuple[float, ...]
) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(3.0,), samples=1)
    # Passes are those of pixel centres, however few rays make the light.
    few = {"open_samples_per_px": 1, "edge_samples_per_px": 1, "surround_samples_per_px": 1, "denoise": False}
    settings = recipe.render.model_copy(update=few)
    pose = RigidTransform(rotation_from_angles(*angles_rad), np.array([0.1, 0.05, 3.0]))
    frame = sample_frame(recipe, 0).model_copy(update={"left_from_drogue": pose})
    ours, theirs = (one.render(frame, settings) for one in (analytic, engine))
    for eye in EYES:
        mine, traced = getattr(ours, eye), getattr(theirs, eye)
        features = [int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + frame.drogue.marker_count)]
        pairs = [(mine.part_id == part, traced.part_id == part) for part in (Part.FACE, Part.HUB)]
        pairs.append((mine.part_id >= FIRST_MARKER_ID, traced.part_id >= FIRST_MARKER_ID))
        for one, other in pairs:
            # The mesh's circles are polygons, 25 um off at most: below 1e-3 of a pixel's width at every edge.
            assert np.count_nonzero(one ^ other) <= max(1e-3 * np.count_nonzero(one | other), 1)
        both = np.isin(mine.part_id, features) & (mine.part_id == traced.part_id)
        # The tracer's depths are float32 over a path of a few roundings, see `test_passes_of_pixel_centres`.
        np.testing.assert_allclose(mine.depth_m[both], traced.depth_m[both], atol=6e-6)
        np.testing.assert_allclose(mine.normal[both], traced.normal[both], atol=1e-5)
        for part in features:
            # Single pixel centres within the polygon's tolerance of the edge.
            assert mine.amodal_px[part] == pytest.approx(traced.amodal_px[part], abs=3)


@pytest.mark.parametrize("tilt_deg", [10.0, 40.0])
def test_labels_stand_the_check(analytic: AnalyticEngine, tilt_deg: float) -> None:
    """Random frames of all distances; at 40 degrees the opening's edge cuts the hub."""
    tilt = Range(low=-tilt_deg, high=tilt_deg)
    recipe = paper_view_recipe(scale=0.5, stations_m=(1.7, 2.5, 5.0, 10.0, 40.0))
    recipe = recipe.model_copy(update={"pose": recipe.pose.model_copy(update={"pitch_deg": tilt, "yaw_deg": tilt})})
    hub_fractions = []
    for index in range(10):
        frame = sample_frame(recipe, index)
        radiance = analytic.render(frame, recipe.render)
        record = label_frame(frame, radiance, expose(frame, radiance))
        assert check_against_passes(record, radiance) == []
        for view in (record.views.left, record.views.right):
            assert {marker.visible_fraction for marker in view.markers} == {1.0}
            hub_fractions.append(view.hub.visible_fraction)
    assert (min(hub_fractions) < 1) == (tilt_deg > 28)


def test_drogue_without_a_hub(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(3.0,))
    frame = with_drogue(sample_frame(recipe, 0), hub=None)
    radiance = analytic.render(frame, recipe.render)
    assert Part.COUPLING in radiance.left.part_id and Part.HUB not in radiance.left.part_id
    record = label_frame(frame, radiance, expose(frame, radiance))
    assert record.views.left.hub is None
    assert check_against_passes(record, radiance) == []


def test_from_behind_a_flat_drogue_shows_its_back_only(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0,))
    turned = RigidTransform(rotation_from_angles(0.1, np.pi - 0.2, 0.0), np.array([0.0, 0.0, 3.0]))
    frame = sample_frame(recipe, 0).model_copy(update={"left_from_drogue": turned})
    radiance = analytic.render(frame, recipe.render)
    assert set(np.unique(radiance.left.part_id)) == {Part.SKY, Part.RIM, Part.FACE}
    assert radiance.left.amodal_px[FIRST_MARKER_ID] > 0
    assert np.allclose(radiance.left.normal[radiance.left.part_id == Part.FACE], turned.rotation[:, 2], atol=1e-7)
    record = label_frame(frame, radiance, expose(frame, radiance))
    assert check_against_passes(record, radiance) == []


def test_drogue_beyond_the_image_and_behind_the_camera(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(3.0,))
    frame = sample_frame(recipe, 0)
    cut, gone, back = (
        frame.model_copy(update={"left_from_drogue": RigidTransform(np.eye(3), np.array(place))})
        for place in ((0.9, 0.0, 3.0), (9.0, 0.0, 3.0), (0.0, 0.0, -3.0))
    )
    seen = analytic.render(cut, recipe.render).left
    # The drogue reaches over the right side of the image.
    assert (seen.part_id[:, -1] != Part.SKY).any()
    assert seen.coverage[:, -1].max() == 1
    assert not seen.coverage[:, : seen.coverage.shape[1] // 2].any()
    assert not analytic.render(gone, recipe.render).left.coverage.any()
    with pytest.raises(ValueError, match="in front of the camera"):
        analytic.render(back, recipe.render)


def test_same_frame_same_bits(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(3.0, 5.0), speed_m_s=2.0, rate_deg_s=20.0)
    first = analytic.render(sample_frame(recipe, 0), recipe.render)
    analytic.render(sample_frame(recipe, 1), recipe.render)
    again = load_engine("analytic").render(sample_frame(recipe, 0), recipe.render)
    for eye in EYES:
        for name in PASSES:
            assert np.array_equal(getattr(getattr(first, eye), name), getattr(getattr(again, eye), name)), name


def test_moving_drogue_is_blurred_around_its_middle(analytic: AnalyticEngine) -> None:
    recipe = paper_view_recipe(stations_m=(5.0,))
    still = sample_frame(recipe, 0)
    still = still.model_copy(update={"exposure": still.exposure.model_copy(update={"time_s": 0.005})})
    across = still.left_from_drogue.rotation.T @ np.array([1.0, 0.5, 0.0])
    moving = still.model_copy(update={"drogue_twist_per_s": np.concatenate([across, np.zeros(3)])})
    travel_px = recipe.rig.camera.fx_px * np.array([1.0, 0.5]) * 0.005 / 5.0
    layout = marker_layout(still.drogue)
    sharp, blurred = (lamp_coverage(analytic, recipe, frame)["left"] for frame in (still, moving))
    for disc in marker_discs(layout, recipe.rig, still.left_from_drogue, "left"):
        area, place = area_and_centroid(blurred, disc, margin_px=4.0)
        still_area, still_place = area_and_centroid(sharp, disc, margin_px=4.0)
        assert area == pytest.approx(still_area, rel=1e-5)
        # Motion across the optical axis is even in the image; what remains is the lattice's share of both centroids.
        assert np.abs(place - still_place).max() < 2 * LATTICE_LAW * disc.semi_axes_px()[1] ** -1.5
        rows, columns = window(disc, 4.0)
        for axis, travel in enumerate(travel_px):
            widths = [(image[rows, columns] > 0).any(axis=axis).sum() for image in (sharp, blurred)]
            # The outermost of the averaged moments stand up to half a step of 0.5 px inside; ends fill whole pixels.
            assert widths[1] - widths[0] == pytest.approx(travel, abs=1.5)


def test_dataset_is_made_and_valid(tmp_path: Path) -> None:
    source = load_recipe("smoke")
    recipe = source.recipe
    recipe = recipe.model_copy(update={"render": recipe.render.model_copy(update={"engine": "analytic"})})
    told = io.StringIO()
    summary = render_dataset(RecipeSource(recipe, source.text), tmp_path / "dataset", range(6), 0, PlainProgress(told))
    assert summary.drops == (), told.getvalue()
    report = validate_dataset(tmp_path / "dataset")
    assert report.faults == []


def test_works_without_mitsuba() -> None:
    code = (
        "import sys; sys.modules['mitsuba'] = sys.modules['drjit'] = None\n"
        "from render.engine import load_engine\nprint(load_engine('analytic').name)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "analytic", done.stderr
