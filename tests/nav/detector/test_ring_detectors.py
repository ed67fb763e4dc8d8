"""The detector of small markers on drawn lamps, clutter and nothing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters, even_ring
from nav.detector.detector_registry import detector_factory, network_file
from nav.detector.ring_detectors import PeakRingDetector

LAMPS = DrogueParameters(
    name="lamps",
    rim_radius_m=0.305,
    face_inner_radius_m=0.25,
    marker_positions_m=even_ring(12, 0.28),
    marker_radius_m=0.01,
    marker_luminance_cd_m2=20000.0,
    marker_emission_rgb=(1.0, 1.0, 1.0),
)


def image_of(middle_px: tuple[float, float], scale_px_per_m: float, rng: np.random.Generator) -> np.ndarray:
    """Lamps of less than a pixel, before the edge of a bright sky, with twenty other lights."""
    image = np.full((240, 320), 300.0)
    image[:60] = 2500
    places = np.array(LAMPS.marker_positions_m) * scale_px_per_m + middle_px
    for x, y in [*places, *rng.uniform((10, 70), (310, 230), (20, 2))]:
        column, row = int(x), int(y)
        image[row : row + 2, column : column + 2] += 3000 * np.outer((1 - y % 1, y % 1), (1 - x % 1, x % 1))
    return (cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0, 15, image.shape)).clip(0, 4095).astype(np.uint16)


@pytest.mark.parametrize("scale_px_per_m", [50.0, 110.0, 250.0])
def test_the_box_is_the_rims_among_other_lights(scale_px_per_m: float) -> None:
    rng, middle = np.random.default_rng(2), (170.0, 150.0)
    images = StereoImages(*(image_of(middle, scale_px_per_m, rng) for _ in range(2)), 0.0, 1e-3, bits=12)
    found = PeakRingDetector(LAMPS).detect(images)
    for one in (found.left, found.right):
        assert one is not None
        x, y, width, height = one.box_xywh_px
        # The peaks are right to a quarter of a pixel each.
        assert np.allclose([x + width / 2, y + height / 2], middle, atol=0.5)
        assert np.allclose([width, height], 0.61 * scale_px_per_m, rtol=0.05)
        assert one.score > 0.5


def test_lights_without_the_arrangement_and_a_drogue_without_markers_have_no_box() -> None:
    rng = np.random.default_rng(4)
    image = rng.normal(300, 15, (240, 320)).astype(np.uint16)
    images = StereoImages(image, image, 0.0, 1e-3, bits=12)
    assert PeakRingDetector(LAMPS).candidates(images, 0.001) == {"left": (), "right": ()}
    bare = LAMPS.model_copy(update={"marker_positions_m": ()})
    found = PeakRingDetector(bare).detect(images)
    assert (found.left, found.right) == (None, None)


def test_it_opens_by_its_name_and_is_no_network() -> None:
    assert detector_factory("peak-ring")(LAMPS).name == "peak-ring"
    assert network_file("peak-ring") is None
