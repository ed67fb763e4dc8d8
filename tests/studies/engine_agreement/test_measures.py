"""How two engines are compared: exact agreement is found, and every kind of disagreement too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from render.engine import EyeRadiance, load_engine
from studies.engine_agreement.agreement import frame_requirements, part_ratios, plate_requirements
from studies.engine_agreement.measures import PlateIlluminance, compare_renderings
from studies.engine_agreement.paired_frames import PairedFrame, RenderedFrame, paired_frames, render_plain_and_lit


@pytest.fixture(scope="module")
def paired() -> PairedFrame:
    return paired_frames(["smoke"], [3.0], 1, 16, seed=3)[0]


@pytest.fixture(scope="module")
def rendered(paired: PairedFrame) -> RenderedFrame:
    return render_plain_and_lit(paired, load_engine("analytic"))


def altered(rendered: RenderedFrame, change: Callable[..., Any]) -> RenderedFrame:
    """The same with every eye changed."""
    plain, lit = (
        replace(stereo, left=change(stereo.left), right=change(stereo.right))
        for stereo in (rendered.plain, rendered.lit)
    )
    return RenderedFrame(plain, lit, rendered.cpu_s)


def missed(paired: PairedFrame, one: RenderedFrame, other: RenderedFrame) -> set[str]:
    agreement = compare_renderings(paired.frame, one, other)
    return {bar.name.split(",")[0] for bar in frame_requirements([agreement], [3.0]) if not bar.reached}


def test_an_engine_agrees_with_itself(paired: PairedFrame, rendered: RenderedFrame) -> None:
    agreement = compare_renderings(paired.frame, rendered, rendered)
    assert agreement.centroids_px.shape == (16, 3, 2)
    assert np.array_equal(agreement.centroids_px[:, 1], agreement.centroids_px[:, 2])
    assert agreement.drogue_iou == 1.0 and agreement.rib_distance_px == 0.0
    assert set(part_ratios([agreement]).values()) == {1.0}
    # Exact coverage on the pixel lattice moves centroids of discs of 9 px radius by 0.04 w^-1.5 = 0.0015 px.
    assert missed(paired, rendered, rendered) == set()


def test_a_picture_that_is_off_by_a_tenth_of_a_pixel_is_found(paired: PairedFrame, rendered: RenderedFrame) -> None:
    def moved(eye: EyeRadiance) -> EyeRadiance:
        image = eye.radiance_cd_m2
        return replace(eye, radiance_cd_m2=0.9 * image + np.float32(0.1) * np.roll(image, 1, axis=1))

    assert {"centroids between the engines", "centroids"} <= missed(paired, rendered, altered(rendered, moved))


def test_masks_and_brightness_that_differ_are_found(paired: PairedFrame, rendered: RenderedFrame) -> None:
    def turned(eye: EyeRadiance) -> EyeRadiance:
        return replace(eye, part_id=np.roll(eye.part_id, 1, axis=0), radiance_cd_m2=eye.radiance_cd_m2 * 1.05)

    assert {"drogue masks up to 5 m", "markers", "rim"} <= missed(paired, rendered, altered(rendered, turned))


def test_a_plate_that_is_too_bright_is_found() -> None:
    plate = PlateIlluminance(0.0, 0.0, one_lux=101.0, other_lux=100.0, integral_lux=100.0)
    (found,) = plate_requirements([plate])
    assert not found.reached and found.value == pytest.approx(0.01)
