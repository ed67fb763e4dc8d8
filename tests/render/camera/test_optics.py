"""The lens against closed forms: vignetting, circles of blur, layers out of focus."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.types.frame import Exposure, FrameSpec, Optics
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import exp_twist
from render.camera.optics import blur_circle_px, disc_kernel, light_on_sensor, transmission
from render.camera.sensor import expose
from render.engine import EyeRadiance, load_engine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import build_recipe, paper_view_recipe, stations

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)


def with_optics(
    frame: FrameSpec, f_number: float = 2.8, psf_sigma_px: float = 0.0, **optics: bool | float
) -> FrameSpec:
    sensor = frame.sensor.model_copy(update={"optics": Optics(**optics), "psf_sigma_px": psf_sigma_px})
    exposure = Exposure(time_s=1e-4, f_number=f_number)
    return frame.model_copy(update={"sensor": sensor, "exposure": exposure})


def rendered(frame: FrameSpec) -> EyeRadiance:
    recipe = load_recipe("pose-tier-a").recipe
    return load_engine("analytic").render(frame, recipe.render).left


def test_default_lens_is_perfect() -> None:
    frame = with_optics(sample_frame(paper_view_recipe(scale=0.25), 0))
    seen = rendered(frame)
    assert light_on_sensor(frame, seen, "left") is seen.radiance_cd_m2


def test_natural_vignetting_is_cos4_of_the_ray() -> None:
    share = transmission(CAMERA, Optics(natural_vignetting=True))
    v, u = np.mgrid[:48, :64]
    rays = CAMERA.rays(np.stack([u, v], axis=-1))
    cosine = 1.0 / np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(share, cosine**4, rtol=1e-6)  # float32


def test_natural_vignetting_behind_a_lens_is_cos4_of_its_ray_from_its_own_axis() -> None:
    lens = Lens(CAMERA, BrownConrady(k1=0.3, p1=0.01), exp_twist([0, 0, 0, 0.02, -0.03, 0.05]).rotation)
    v, u = np.mgrid[:48, :64]
    rays = lens.rays(np.stack([u, v], axis=-1)) @ lens.ideal_from_real
    cosine = rays[..., 2] / np.linalg.norm(rays, axis=-1)
    share = transmission(CAMERA, Optics(natural_vignetting=True), lens)
    np.testing.assert_allclose(share, cosine**4, rtol=1e-6)  # float32
    assert share[0, 0] > 1.1 * transmission(CAMERA, Optics(natural_vignetting=True))[0, 0]


def test_mechanical_falloff_takes_its_share_in_the_corner_only() -> None:
    share = transmission(CAMERA, Optics(mechanical_falloff_fraction=0.3))
    assert share[0, 0] == pytest.approx(0.7, rel=1e-6)
    # Half a pixel from the axis; half way to the corner it takes a sixteenth.
    assert share[23, 31] == pytest.approx(1.0, abs=1e-6)
    assert share[12, 16] == pytest.approx(1 - 0.3 / 16, abs=3e-3)


def test_vignetting_takes_electrons_and_their_noise() -> None:
    """Both ends of the chain: the corner's mean falls by the transmission."""
    frame = with_optics(sample_frame(paper_view_recipe(scale=0.25), 0), natural_vignetting=True)
    plain = with_optics(frame)
    seen = rendered(frame)
    ratio = light_on_sensor(frame, seen, "left") / light_on_sensor(plain, seen, "left")
    np.testing.assert_allclose(ratio[..., 1], transmission(frame.rig.camera, frame.sensor.optics), rtol=1e-6)


@pytest.mark.parametrize("diameter_px", [0.1, 0.4, 1.0, 2.44, 7.3, 31.0])
def test_disc_kernel_has_the_disc_s_moments(diameter_px: float) -> None:
    kernel = disc_kernel(diameter_px)
    reach = kernel.shape[0] // 2
    x = np.arange(-reach, reach + 1)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-12)
    # Chords in the middles of 64 strips a pixel: the second moment of a strip errs by (1/64)^2 / 12 at most.
    assert kernel.sum(axis=0) @ x**2 == pytest.approx(diameter_px**2 / 16, rel=2e-3, abs=2e-5)
    np.testing.assert_allclose(kernel, kernel.T, atol=1e-15)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)


def test_wide_disc_kernel_is_flat_with_a_hard_edge() -> None:
    kernel = disc_kernel(31.0)
    middle = kernel[
        kernel.shape[0] // 2 - 8 : kernel.shape[0] // 2 + 9, kernel.shape[0] // 2 - 8 : kernel.shape[0] // 2 + 9
    ]
    # An even disc of the same area; the pixels' own box is taken off its diameter, 1/12 of 60 px^2.
    assert middle.mean() == pytest.approx(1 / (np.pi * 15.5**2), rel=2e-3)
    assert middle.std() < 1e-6


def test_blur_circle_follows_the_thin_lens() -> None:
    """Diameter against the image distances of the lens formula, worked out without the closed form."""
    frame = with_optics(sample_frame(paper_view_recipe(), 0), focus_distance_m=10.0)
    focal_px = frame.rig.camera.fx_px
    image_m = focal_px * 3.75e-6
    power = 1 / image_m + 1 / 10.0
    for depth_m in (2.0, 5.0, 40.0, np.inf):
        meets_m = 1 / (power - 1 / depth_m)
        wanted_px = image_m / 2.8 * abs(meets_m - image_m) / meets_m / 3.75e-6
        assert blur_circle_px(frame, depth_m) == pytest.approx(wanted_px, rel=1e-9)
    assert blur_circle_px(frame, 10.0) == 0.0
    # 2.86 mm x 2133 px x (1/2 - 1/10) / m.
    assert blur_circle_px(frame, 2.0) == pytest.approx(2.44, abs=0.01)
    closed = frame.model_copy(update={"exposure": Exposure(time_s=1e-4, f_number=5.6)})
    assert blur_circle_px(closed, 2.0) == pytest.approx(blur_circle_px(frame, 2.0) / 2, rel=1e-12)


def test_defocus_softens_the_target_and_keeps_its_light_and_place() -> None:
    frame = sample_frame(paper_view_recipe(scale=0.5, stations_m=(3.0,)), 0)
    near = with_optics(frame, f_number=0.5, focus_distance_m=30.0)
    sharp = with_optics(frame, f_number=0.5)
    seen = rendered(sharp)
    soft_image, sharp_image = light_on_sensor(near, seen, "left"), light_on_sensor(sharp, seen, "left")
    assert blur_circle_px(near, 3.0) > 2
    step = [np.abs(np.diff(image[..., 0], axis=1)).max() for image in (soft_image, sharp_image)]
    assert step[0] < 0.6 * step[1]
    # The whole target lies in the image: light only moves by a circle's radius, and the sky is smooth.
    np.testing.assert_allclose(soft_image.mean(axis=(0, 1)), sharp_image.mean(axis=(0, 1)), rtol=2e-3)
    marks = [(image[..., 0] - image[..., 1:].max(axis=-1)).clip(min=0) for image in (soft_image, sharp_image)]
    v, u = np.mgrid[: marks[0].shape[0], : marks[0].shape[1]]
    centers = [np.array([(mark * u).sum(), (mark * v).sum()]) / mark.sum() for mark in marks]
    np.testing.assert_allclose(centers[0], centers[1], atol=0.3)


def test_target_in_focus_before_a_soft_sky() -> None:
    frame = sample_frame(paper_view_recipe(scale=0.5, stations_m=(3.0,)), 0)
    focused = with_optics(frame, f_number=1.0, focus_distance_m=3.0)
    seen = rendered(focused)
    image = light_on_sensor(focused, seen, "left")
    inside = seen.coverage == 1
    # Where the target covers whole pixels its own light is untouched, but for float32.
    np.testing.assert_allclose(image[inside], seen.radiance_cd_m2[inside], rtol=1e-5)


def test_a_blur_without_end_is_refused() -> None:
    frame = with_optics(sample_frame(paper_view_recipe(), 0), f_number=0.5, focus_distance_m=0.06)
    with pytest.raises(ValueError, match="focus_distance_m: gives a blur circle"):
        light_on_sensor(frame, rendered(with_optics(frame)), "left")


def test_recipe_keys_reach_the_sensor() -> None:
    optics = {"natural_vignetting": True, "mechanical_falloff_fraction": 0.2, "focus_distance_m": 12.0}
    recipe = build_recipe(
        name="lens", rig={"preset": "mono", "optics": optics}, frames={"count": 1}, distance=stations(5.0)
    )
    assert recipe.sensor.optics == Optics(
        natural_vignetting=True, mechanical_falloff_fraction=0.2, focus_distance_m=12.0
    )
    images = expose(
        *(lambda frame: (frame, load_engine("analytic").render(frame, recipe.render)))(sample_frame(recipe, 0))
    )
    assert images.left.ndim == 2
