from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.types.records import FeatureView, PairRecord
from drogue_models.parts import FIRST_MARKER_ID, Part
from labelgen.label_errors import LATTICE_RMS
from labelgen.validation.label_checks import check_against_passes
from render.engine import StereoRadiance
from tests.support.drawn_pairs import Pair


def centroid_errors(longer_px: float, shorter_px: float, count: int) -> np.ndarray:
    """Lengths of the errors of drawn ellipses' centroids at random places and turns. [px]"""
    rng = np.random.default_rng(7)
    reach = np.arange(-int(longer_px + 2), int(longer_px + 3))
    u, v = np.meshgrid(reach, reach)
    errors = []
    for _ in range(count):
        (du, dv), turn = rng.uniform(-0.5, 0.5, 2), rng.uniform(0, np.pi)
        along = (u - du) * np.cos(turn) + (v - dv) * np.sin(turn)
        across = (v - dv) * np.cos(turn) - (u - du) * np.sin(turn)
        inside = (along / longer_px) ** 2 + (across / shorter_px) ** 2 <= 1
        errors.append(np.hypot(u[inside].mean() - du, v[inside].mean() - dv))
    return np.array(errors)


def test_lattice_law_of_discs() -> None:
    radii_px = np.array([2.7, 4.1, 5.3, 7.6, 10.7, 15.2, 21.0, 34.5, 53.0])
    rms_px = []
    for radius_px in radii_px:
        errors = centroid_errors(radius_px, radius_px, 300)
        law_px = LATTICE_RMS / np.sqrt(radius_px)
        rms_px.append(np.sqrt((errors**2).mean()))
        # The law counts boundary pixels as independent; a given radius resonates with the lattice by up to a quarter.
        assert rms_px[-1] == pytest.approx(law_px, rel=0.3)
        assert errors.max() < 4 * law_px
    slope = np.polyfit(np.log(radii_px), np.log(rms_px), 1)[0]
    # Resonances of a tenth (rms) at nine radii over three octaves and a half leave 0.04.
    assert slope == pytest.approx(-0.5, abs=0.12)


@pytest.mark.parametrize(("longer_px", "shorter_px"), [(2.7, 1.35), (10.0, 7.0), (20.0, 10.0), (30.0, 28.0)])
def test_lattice_law_bounds_ellipses(longer_px: float, shorter_px: float) -> None:
    errors = centroid_errors(longer_px, shorter_px, 600)
    law = LATTICE_RMS * np.sqrt(longer_px) / shorter_px
    # Along the long axis the error has this size, across it a smaller one.
    assert np.sqrt((errors**2).mean()) < 1.1 * law
    assert errors.max() < 4 * law


def test_true_labels_pass(pairs: list[Pair]) -> None:
    for pair in pairs:
        assert check_against_passes(pair.record, pair.radiance) == []


def with_left(pair: Pair, **changes: dict[int, int] | np.ndarray) -> StereoRadiance:
    """The passes with changes to the left eye."""
    return replace(pair.radiance, left=replace(pair.radiance.left, **changes))


def with_view(pair: Pair, **changes: tuple[FeatureView | float, ...]) -> PairRecord:
    """The record with changes to the left view."""
    views = pair.record.views
    left = views.left.model_copy(update=changes)
    return pair.record.model_copy(update={"views": views.model_copy(update={"left": left})})


def moved_marker(pair: Pair, name: str, shift_px: float) -> PairRecord:
    markers = list(pair.record.views.left.markers)
    point = getattr(markers[0], name)
    markers[0] = markers[0].model_copy(update={name: (point[0] + shift_px, point[1])})
    return with_view(pair, markers=tuple(markers))


def test_half_a_pixel_is_found_in_near_frames(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    faults = check_against_passes(moved_marker(pair, "center_ellipse_px", 0.5), pair.radiance)
    assert len(faults) == 1 and "left: markers[0]: center_ellipse_px" in faults[0]


def test_a_center_on_another_part_is_found(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    ids = pair.radiance.left.part_id.copy()
    column, row = np.rint(pair.record.views.left.markers[0].center_proj_px).astype(int)
    ids[row, column], ids[row, column + 1] = FIRST_MARKER_ID + 1, FIRST_MARKER_ID
    faults = check_against_passes(pair.record, with_left(pair, part_id=ids))
    assert any(f"markers[0]: center_proj_px: pixel {column}, {row} sees part 33" in fault for fault in faults)


def test_ray_length_instead_of_planar_depth_is_found(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    height, width = pair.radiance.left.depth_m.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    longer = np.linalg.norm(pair.frame.rig.camera.rays(pixels), axis=-1).astype(np.float32)
    faults = check_against_passes(pair.record, with_left(pair, depth_m=pair.radiance.left.depth_m * longer))
    assert sum("off the plane" in fault for fault in faults) == 9


def test_depth_error_of_a_tenth_of_a_millimetre_is_found(full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        depth = pair.radiance.left.depth_m + np.float32(1e-4)
        assert sum(
            "off the plane" in fault for fault in check_against_passes(pair.record, with_left(pair, depth_m=depth))
        )


def test_a_marker_that_spreads_over_the_face_is_found(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    ids = pair.radiance.left.part_id.copy()
    rows, columns = np.nonzero(ids == FIRST_MARKER_ID)
    ids[rows[0] - 2, columns[0]] = FIRST_MARKER_ID
    amodal = pair.radiance.left.amodal_px | {FIRST_MARKER_ID: len(rows) + 1}
    faults = check_against_passes(pair.record, with_left(pair, part_id=ids, amodal_px=amodal))
    assert len(faults) == 1 and "markers[0]: 1 pixels of part 32 lie beyond its edge" in faults[0]


def test_wrong_visibility_is_found(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    amodal = dict(pair.radiance.left.amodal_px)
    amodal[int(Part.HUB)] -= 1
    faults = check_against_passes(pair.record, with_left(pair, amodal_px=amodal))
    assert len(faults) == 1 and "left: hub:" in faults[0] and "visible of only" in faults[0]
    amodal[int(Part.HUB)] += 11
    faults = check_against_passes(pair.record, with_left(pair, amodal_px=amodal))
    assert len(faults) == 1 and "visible_fraction" in faults[0]


@pytest.mark.parametrize("change", [(-1, 0, 0, 0), (0, 0, 1, 0), (0, 0.5, 0, 0)])
def test_wrong_visible_boxes_are_found(full_pairs: list[Pair], change: tuple[int, float, int, int]) -> None:
    pair = full_pairs[0]
    box = tuple(a + b for a, b in zip(pair.record.views.left.box_visible_xywh_px, change, strict=True))
    assert "box_visible_xywh_px" in check_against_passes(with_view(pair, box_visible_xywh_px=box), pair.radiance)[0]


def test_a_full_box_that_is_too_small_is_found(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    u, v, width, height = pair.record.views.left.box_full_xywh_px
    faults = check_against_passes(with_view(pair, box_full_xywh_px=(u + 2.5, v, width - 2.5, height)), pair.radiance)
    assert len(faults) == 1 and "not inside box_full_xywh_px" in faults[0]


def test_a_drogue_in_an_empty_frame_is_found(pairs: list[Pair], full_pairs: list[Pair]) -> None:
    empty = next(pair for pair in pairs if pair.frame.drogue is None)
    assert len(check_against_passes(empty.record, full_pairs[0].radiance)) == 2
    labelled = empty.record.model_copy(update={"views": full_pairs[0].record.views})
    assert "although the frame is empty" in check_against_passes(labelled, empty.radiance)[0]


def test_missing_markers_are_found(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    markers = pair.record.views.left.markers[:7]
    faults = check_against_passes(with_view(pair, markers=markers), pair.radiance)
    assert len(faults) == 1 and "left: markers, hub: 7 markers are labelled, the drogue has 8" in faults[0]
