"""A drawn camera: nothing moves, noise is correlated as in photographs, tones and codes are the standards'."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.images import Pixels, light_from_srgb
from datasets_manifest.types.video_camera import (
    ImageCoding,
    ImageProcessing,
    LensFlaws,
    Overlay,
    Spectrum,
    VideoCamera,
    Window,
)
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from render.camera.image_coding import draw_overlay, intra_coded, jpeg, one_field
from render.camera.image_processing import metered, noise_by_level, tone_tables
from render.camera.optics import saturation_cd_m2
from render.camera.sensor import expose
from render.camera.video_lens import add_bloom, ghosts, see_through, shift_colors
from render.engine import EyeRadiance, StereoRadiance
from scenes.sampler import sample_frame
from tests.support.recipe_builder import paper_view_recipe

WIDTH, HEIGHT = 320, 240
SPACING_PX = 32
# Nothing may move by more; a marker's centre is measured to some hundredths of a pixel.
MOST_SHIFT_PX = 0.02


@pytest.fixture(scope="module")
def frame() -> FrameSpec:
    frame = sample_frame(paper_view_recipe(scale=0.25), 0)
    # Small discs that are light enough for a short exposure; the sun is behind the camera.
    sensor = frame.sensor.model_copy(update={"encoding": "gamma", "full_well_e": 1e6, "read_noise_e": 0.0})
    sensor = sensor.model_copy(update={"prnu_fraction": 0.0, "responsivity_e_per_lux_s": 1e6})
    return frame.model_copy(update={"sensor": sensor})


def disc_centers() -> Array:
    """(N, 2) at every phase of the pixel grid, with room around each."""
    u, v = np.meshgrid(np.arange(1, WIDTH // SPACING_PX) * SPACING_PX, np.arange(1, HEIGHT // SPACING_PX) * SPACING_PX)
    grid = np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)
    centers: Array = grid + np.random.default_rng(3).uniform(-0.5, 0.5, grid.shape)
    return centers


def discs(low: float = 0.1, high: float = 0.5, diameter_px: float = 9.0) -> NDArray[np.float32]:
    """(H, W) light with sharp discs, box-sampled in 1/8 px."""
    fine = 8
    image = np.full((HEIGHT * fine, WIDTH * fine), low, np.float32)
    for center in disc_centers():
        at = np.rint(((center + 0.5) * fine - 0.5) * 16).astype(int)
        cv2.circle(image, tuple(map(int, at)), round(diameter_px / 2 * fine * 16), high, -1, shift=4)
    sampled: NDArray[np.float32] = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return sampled


def moved_px(before: NDArray, after: NDArray) -> Array:  # type: ignore[type-arg]
    """(2,) mean shift of the discs' centres of gravity over their windows; levels may be scaled and offset."""
    shifts = []
    for u, v in np.rint(disc_centers()).astype(int):
        window = slice(v - 12, v + 13), slice(u - 12, u + 13)
        shifts.append(_center(after[window]) - _center(before[window]))
    shift: Array = np.abs(np.mean(shifts, axis=0))
    return shift


def _center(window: NDArray) -> Array:  # type: ignore[type-arg]
    light = window.astype(np.float64)
    # The faint rest of the window would weigh as much as the disc by its long arm.
    light = np.maximum(light - np.median(light) - 0.1 * np.ptp(light), 0.0)
    v, u = np.mgrid[: light.shape[0], : light.shape[1]]
    center: Array = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
    return center


def flat_light(level: float) -> NDArray[np.float32]:
    return np.full((HEIGHT, WIDTH), level, np.float32)


def pair_of(light: NDArray[np.float32], frame: FrameSpec) -> StereoRadiance:
    """Both eyes see light in shares of what saturates the sensor."""
    seen = np.repeat(light[..., None] * np.float32(saturation_cd_m2(frame)), 3, axis=2)
    nothing = np.zeros(light.shape, np.float32)
    eye = EyeRadiance(
        radiance_cd_m2=seen,
        coverage=nothing + 1.0,
        part_id=nothing.astype(np.uint8),
        depth_m=nothing,
        normal=np.zeros((*light.shape, 3), np.float32),
        amodal_px={},
    )
    return StereoRadiance(
        left=eye, right=eye, engine="test", engine_version="1", monte_carlo_noise_fraction=0.0, stage_s={}
    )


def tinted_pair(level: float, tint: tuple[float, float, float], frame: FrameSpec) -> StereoRadiance:
    """Both eyes see one colour all over."""
    pair = pair_of(flat_light(level), frame)
    eye = pair.left
    coloured = EyeRadiance(**{**vars(eye), "radiance_cd_m2": eye.radiance_cd_m2 * np.array(tint, np.float32)})
    return StereoRadiance(**{**vars(pair), "left": coloured, "right": coloured})


def with_camera(frame: FrameSpec, camera: VideoCamera | None, **sensor: float) -> FrameSpec:
    return frame.model_copy(update={"camera": camera, "sensor": frame.sensor.model_copy(update=sensor)})


PROCESSING = ImageProcessing(
    white_balance=(1.05, 0.95), exposure_factor=1.6, contrast=0.3, kept_detail_fraction=0.2, sharpen=0.8
)
BILINEAR = PROCESSING.model_copy(update={"demosaic": "bilinear"})
LENS = LensFlaws(lateral_red_px=1.5, lateral_blue_px=-1.2, bloom_fraction=0.05)

CAMERAS = {
    "lens": VideoCamera(lens=LENS),
    "edge-aware": VideoCamera(processing=PROCESSING),
    "bilinear": VideoCamera(processing=BILINEAR),
    "grey": VideoCamera(spectrum="grey", processing=PROCESSING),
    "near-infrared": VideoCamera(spectrum="near-infrared"),
    "jpeg": VideoCamera(coding=ImageCoding(codec="jpeg", quality=70)),
    "video": VideoCamera(coding=ImageCoding(codec="h264-intra", quantizer=28)),
    "half size": VideoCamera(coding=ImageCoding(resolution_fraction=0.5)),
    "odd size": VideoCamera(coding=ImageCoding(resolution_fraction=0.677)),
    "interlaced": VideoCamera(coding=ImageCoding(is_interlaced=True)),
    "all": VideoCamera(
        lens=LENS,
        processing=PROCESSING,
        coding=ImageCoding(codec="h264-intra", quantizer=24, resolution_fraction=0.8),
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_centers_stay_where_the_rig_says(frame: FrameSpec, name: str) -> None:
    """Green, which lateral colour leaves in place, against a camera without any of it."""
    light = pair_of(discs(), frame)
    plain = expose(with_camera(frame, None), light).left
    drawn = expose(with_camera(frame, CAMERAS[name]), light).left
    assert drawn.shape == plain.shape and drawn.dtype == np.uint8
    assert not np.array_equal(drawn, plain)
    assert moved_px(plain[..., 1], drawn[..., 1]).max() < MOST_SHIFT_PX


def test_lateral_color_is_as_large_in_the_corner_as_it_says_and_leaves_green(frame: FrameSpec) -> None:
    camera = PinholeCamera(WIDTH, HEIGHT, 500.0, 500.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    light = np.repeat(discs()[..., None], 3, axis=2)
    flaws = LensFlaws(lateral_red_px=2.0, lateral_blue_px=-1.0)
    shifted = shift_colors(light, flaws, camera)
    np.testing.assert_array_equal(shifted[..., 1], light[..., 1])
    middle = np.array([camera.cx_px, camera.cy_px])
    corner_px = np.hypot(*middle)
    for channel, wanted_px in ((0, 2.0), (2, -1.0)):
        for place in disc_centers():
            u, v = np.rint(place).astype(int)
            window = slice(v - 12, v + 13), slice(u - 12, u + 13)
            moved = _center(shifted[(*window, channel)]) - _center(light[(*window, channel)])
            # OpenCV's table of interpolation has steps of 1/32 px, and these discs have sharp edges.
            np.testing.assert_allclose(moved, wanted_px * (place - middle) / corner_px, atol=0.05)


def test_bloom_spreads_a_share_of_the_light_by_the_inverse_square_of_the_distance() -> None:
    size, place = 513, 256
    light = np.zeros((size, size, 3), np.float32)
    light[place, place] = 1e6
    bloomed = add_bloom(light, 0.1, np.inf)
    assert bloomed[place, place, 0] > 0.9e6
    spread = (bloomed - 0.9 * light)[..., 0].astype(float)
    distance = np.hypot(*(np.mgrid[:size, :size] - place))
    # Light beyond the border of the picture is lost, and comes back where the border is repeated.
    assert spread.sum() == pytest.approx(0.1e6, rel=0.05)
    rings = [spread[(distance > radius) & (distance < 1.2 * radius)].mean() for radius in (10, 20, 40, 80)]
    slopes = np.diff(np.log(rings)) / np.log(2.0)
    # The law's own slope is -2; a sum of Gaussians undulates about it, and ends with the widest.
    np.testing.assert_allclose(slopes, -2.0, atol=0.45)
    flat = np.full((64, 96, 3), 7.0, np.float32)
    np.testing.assert_allclose(add_bloom(flat, 0.1, np.inf), flat, rtol=1e-5)


def test_ghosts_lie_on_the_line_through_the_sun_and_hold_its_share_of_light() -> None:
    camera = PinholeCamera(WIDTH, HEIGHT, 500.0, 500.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    flaws = LensFlaws(ghost_fraction=1e-4, ghost_seed=4)
    drawn = ghosts(flaws, camera, np.array([0.1, 0.0, 0.995]), np.full(3, 1e5))
    assert drawn.shape == (HEIGHT, WIDTH, 3) and drawn.min() >= 0 and drawn.max() > 0
    rows = np.arange(HEIGHT) @ drawn.sum(axis=(1, 2)) / drawn.sum()
    assert rows == pytest.approx(camera.cy_px, abs=0.5)
    total = drawn.sum(axis=(0, 1)).max() / 500.0**2
    assert total < 6 * 1e-4 * 1e5


def test_each_eye_looks_through_another_part_of_the_same_window() -> None:
    window = Window(seed=7, dirt_fraction=0.1, scratches=5, drops=5, reflection_fraction=0.05)
    light = np.full((HEIGHT, WIDTH, 3), 100.0, np.float32)
    left, again, right = (see_through(light, window, eye, np.inf, np.zeros(3)) for eye in ("left", "left", "right"))
    np.testing.assert_array_equal(left, again)
    assert np.abs(left - right).max() > 1.0
    assert left.min() > 40.0 and left.max() < 250.0


def test_a_window_scatters_sunlight_as_it_does_that_of_as_bright_a_view() -> None:
    window = Window(seed=7, dirt_fraction=0.1, scratches=5)
    dark, light = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.full((HEIGHT, WIDTH, 3), 100.0, np.float32)
    by_view = see_through(light, window, "left", np.inf, np.zeros(3)) - see_through(
        light, window, "left", 0, np.zeros(3)
    )
    by_sun = see_through(dark, window, "left", np.inf, np.full(3, 100.0 * np.pi))
    # The first is a difference of float32 numbers around 100.
    np.testing.assert_allclose(by_sun, by_view, atol=1e-4)


def lag_one(picture: Pixels, other: Pixels) -> float:
    """Correlation of the noise of neighbours, by the difference of two pictures of the same scene."""
    noise = picture.astype(float) - other.astype(float)
    return float(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1])


@pytest.mark.parametrize(
    ("camera", "low", "high"),
    [
        (None, -0.02, 0.02),
        (VideoCamera(processing=PROCESSING), 0.45, 0.96),
        (VideoCamera(processing=BILINEAR.model_copy(update={"kept_detail_fraction": 0.4})), 0.45, 0.96),
    ],
)
def test_processing_correlates_noise_as_in_photographs(
    frame: FrameSpec, camera: VideoCamera | None, low: float, high: float
) -> None:
    """The range is that of 60 photographs' flat patches; noise of a sensor alone is white."""
    noisy = with_camera(frame, camera, full_well_e=3000.0, responsivity_e_per_lux_s=3000.0)
    pair = expose(noisy, pair_of(flat_light(0.15), noisy))
    assert low <= lag_one(pair.left[..., 1], pair.right[..., 1]) <= high


@pytest.mark.parametrize("spectrum", ["colour", "grey"])
@pytest.mark.parametrize("black_fraction", [-0.02, 0.04])
def test_the_black_level_is_what_a_picture_without_light_shows(
    frame: FrameSpec, spectrum: Spectrum, black_fraction: float
) -> None:
    processing = PROCESSING.model_copy(update={"black_fraction": black_fraction})
    dark = with_camera(frame, VideoCamera(spectrum=spectrum, processing=processing), noise_free=True)
    images = expose(dark, pair_of(flat_light(0.0), dark))
    assert set(np.unique(images.left)) == {images.black_level_dn}
    assert images.black_level_dn == pytest.approx(255 * max(black_fraction, 0.0), abs=0.5)  # rounding


@pytest.mark.parametrize("level", [0.01, 0.15, 0.6])
def test_noise_is_known_at_every_level(frame: FrameSpec, level: float) -> None:
    """Against the noise of a monochrome picture that is not denoised."""
    processing = ImageProcessing(exposure_factor=1.5)
    camera = VideoCamera(spectrum="grey", processing=processing)
    noisy = with_camera(frame, camera, full_well_e=3000.0, responsivity_e_per_lux_s=3000.0, read_noise_e=5.0)
    shown = expose(noisy, pair_of(flat_light(level), noisy)).left[..., 0].astype(float)
    told = noise_by_level(noisy, processing)[round(shown.mean())]
    # Rounding to whole levels adds a twelfth; in the dark the curve bends within the noise.
    assert np.sqrt(shown.var() - 1 / 12) == pytest.approx(told, rel=0.06)


def test_both_eyes_and_all_runs_have_the_same_camera_and_noise_of_their_own(frame: FrameSpec) -> None:
    noisy = with_camera(frame, CAMERAS["all"], full_well_e=3000.0, responsivity_e_per_lux_s=3000.0)
    light = pair_of(discs(), noisy)
    first, second = expose(noisy, light), expose(noisy, light)
    np.testing.assert_array_equal(first.left, second.left)
    np.testing.assert_array_equal(first.right, second.right)
    assert not np.array_equal(first.left, first.right)
    assert np.abs(first.left.astype(float) - first.right.astype(float)).mean() < 10


def test_tones_are_the_srgb_curve_when_nothing_else_is_asked() -> None:
    tables = tone_tables(ImageProcessing(), 12, 64)
    signal = np.clip((np.arange(4096) - 64) / (4095 - 64), 0, 1)
    wanted = np.where(signal <= 0.0031308, 12.92 * signal, 1.055 * signal ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(tables, np.tile(255 * wanted, (3, 1)), atol=1e-3)


def test_white_stays_white_under_a_wrong_white_balance() -> None:
    tables = tone_tables(PROCESSING, 12, 64)
    np.testing.assert_array_equal(tables[:, -1], 255.0)
    assert (np.diff(tables, axis=1) >= 0).all()


def test_a_flat_colour_keeps_its_colour(frame: FrameSpec) -> None:
    """Through mosaic, interpolation, luma and chroma."""
    light = tinted_pair(0.3, (1.0, 0.6, 0.3), frame)
    plain = expose(with_camera(frame, None), light).left[20:-20, 20:-20].mean(axis=(0, 1))
    drawn = expose(with_camera(frame, VideoCamera(processing=ImageProcessing())), light).left
    np.testing.assert_allclose(drawn[20:-20, 20:-20].mean(axis=(0, 1)), plain, atol=1.0)


@pytest.mark.parametrize(("level", "tint"), [(0.2, (1.0, 0.8, 0.7)), (0.2, (1.0, 0.3, 0.02)), (0.95, (1.0, 0.9, 0.8))])
def test_saturation_spares_strong_colours_and_highlights_fade(
    frame: FrameSpec, level: float, tint: tuple[float, float, float]
) -> None:
    """A weak colour gains 1.5, a strong one less, and at white half of it is gone."""
    pair = tinted_pair(level, tint, frame)
    red, green, blue = expose(with_camera(frame, None), pair).left[20:-20, 20:-20].mean(axis=(0, 1))
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    strength = max(abs(red - luma), abs(blue - luma)) / 256
    amount = (1.0 + 0.5 * (1.0 - strength)) * (1.0 - 0.5 * (max(luma - 165.0, 0.0) / 90.0) ** 2)
    drawn = expose(with_camera(frame, VideoCamera(processing=ImageProcessing(saturation=1.5))), pair).left
    got = drawn[20:-20, 20:-20].mean(axis=(0, 1))
    # Clipped where a channel would leave the range.
    expected = np.clip(luma + amount * (np.array([red, blue]) - luma), 0.0, 255.0)
    np.testing.assert_allclose(got[[0, 2]], expected, atol=2.0)


@pytest.mark.parametrize("saturation", [0.0, 0.5])
def test_less_saturation_takes_as_much_of_strong_colours(frame: FrameSpec, saturation: float) -> None:
    """At 0 all is grey."""
    pair, middle = tinted_pair(0.2, (1.0, 0.3, 0.02), frame), (slice(20, -20), slice(20, -20))
    chroma = []
    for factor in (1.0, saturation):
        camera = VideoCamera(processing=ImageProcessing(saturation=factor))
        red, _, blue = expose(with_camera(frame, camera), pair).left[middle].mean(axis=(0, 1))
        chroma.append(red - blue)
    assert chroma[0] > 100
    # Pictures are of whole numbers.
    assert chroma[1] == pytest.approx(saturation * chroma[0], abs=1.0)


def test_darkness_is_denoised_over_wider_parts(frame: FrameSpec) -> None:
    """At the same level the noise of a high gain is correlated farther."""
    farther = []
    for full_well_e in (20_000.0, 300.0):
        noisy = with_camera(
            frame, VideoCamera(processing=PROCESSING), full_well_e=full_well_e, responsivity_e_per_lux_s=full_well_e
        )
        pair = expose(noisy, pair_of(flat_light(0.15), noisy))
        noise = pair.left[..., 1].astype(float) - pair.right[..., 1]
        farther.append(float(np.corrcoef(noise[:, 3:].ravel(), noise[:, :-3].ravel())[0, 1]))
    assert farther[1] > farther[0] + 0.1


@pytest.mark.parametrize("level", [0.1, 0.7])
def test_a_bright_view_is_shown_no_brighter_than_asked(frame: FrameSpec, level: float) -> None:
    camera = VideoCamera(processing=ImageProcessing(exposure_factor=1.8, brightest_mean_fraction=0.3))
    shown = expose(with_camera(frame, camera), pair_of(flat_light(level), frame)).left[..., 1].mean() / 255
    wanted = 0.3 if level == 0.7 else 1.8 * level / (1 + 0.8 * level)
    assert light_from_srgb(np.array(shown)) == pytest.approx(wanted, rel=0.02)


def test_the_colour_of_a_view_is_taken_as_far_to_grey_as_asked(frame: FrameSpec) -> None:
    pair = pair_of(flat_light(0.2), frame)
    tint = np.array([1.2, 1.0, 0.8], np.float32)
    coloured = EyeRadiance(**{**vars(pair.left), "radiance_cd_m2": pair.left.radiance_cd_m2 * tint})
    light = StereoRadiance(**{**vars(pair), "left": coloured, "right": coloured})
    for share in (0.0, 0.5, 1.0):
        camera = VideoCamera(processing=ImageProcessing(neutral_fraction=share))
        shown = expose(with_camera(frame, camera), light).left[20:-20, 20:-20].mean(axis=(0, 1)) / 255
        linear = light_from_srgb(shown)
        np.testing.assert_allclose(linear / linear[1], tint ** (1.0 - share), rtol=0.02)


@pytest.mark.parametrize("exponent", np.linspace(-3.0, -1.0, 40).tolist())
def test_a_picture_white_all_over_may_stay_so(frame: FrameSpec, exponent: float) -> None:
    white = [np.full((8, 8), 2**frame.sensor.adc_bits - 1, np.uint16)] * 2
    given = ImageProcessing(exposure_factor=2.0**exponent, brightest_mean_fraction=1.0)
    assert metered(given, frame, white).exposure_factor == given.exposure_factor


def test_infrared_darkens_the_sky_brightens_leaves_and_leaves_grey(frame: FrameSpec) -> None:
    visible, infrared = (with_camera(frame, VideoCamera(spectrum=spectrum)) for spectrum in ("grey", "near-infrared"))
    shares = []
    for colour in ([0.2, 0.4, 0.9], [0.05, 0.09, 0.03], [0.4, 0.4, 0.4]):
        pair = pair_of(flat_light(0.2), frame)
        tint = np.array(colour, np.float32)
        seen = EyeRadiance(**{**vars(pair.left), "radiance_cd_m2": pair.left.radiance_cd_m2 * tint})
        light = StereoRadiance(**{**vars(pair), "left": seen, "right": seen})
        levels = [expose(each, light).left[20:-20, 20:-20].mean() / 255 for each in (infrared, visible)]
        shares.append(light_from_srgb(np.array(levels[0])) / light_from_srgb(np.array(levels[1])))
    sky, leaves, grey = shares
    assert sky < 0.25 and leaves > 3.0
    assert grey == pytest.approx(1.0, rel=0.02)


def test_jpeg_is_that_of_another_codec() -> None:
    picture = _photograph()
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=75, subsampling="4:2:0")
    # Decoders may differ in the last bit of their transform and of their colours.
    assert np.abs(jpeg(picture, 75).astype(int) - np.asarray(Image.open(stream)).astype(int)).mean() < 0.5


def test_intra_coding_loses_about_what_h264_loses() -> None:
    """Against x264 at a constant quantiser, with intra pictures alone."""
    av = pytest.importorskip("av")
    luma = cv2.cvtColor(_photograph(), cv2.COLOR_RGB2GRAY)
    planes = np.vstack([luma, np.full((HEIGHT // 2, WIDTH), 128, np.uint8)])
    for quantizer in (22, 34):
        stream = io.BytesIO()
        with av.open(stream, "w", format="mp4") as container:
            video = container.add_stream("libx264", rate=25)
            video.width, video.height, video.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            video.options = {"qp": str(quantizer), "g": "1", "x264-params": "ipratio=1.0"}
            for packet in (*video.encode(av.VideoFrame.from_ndarray(planes, format="yuv420p")), *video.encode()):
                container.mux(packet)
        stream.seek(0)
        with av.open(stream) as container:
            decoded = next(container.decode(video=0)).to_ndarray()[:HEIGHT]
        ours, theirs = _psnr_db(intra_coded(luma, quantizer), luma), _psnr_db(decoded, luma)
        assert ours == pytest.approx(theirs, abs=2.0)


def _photograph() -> NDArray[np.uint8]:
    """Smooth shapes, edges and texture."""
    rng = np.random.default_rng(5)
    noise = cv2.GaussianBlur(rng.normal(0, 60, (HEIGHT, WIDTH, 3)).astype(np.float32), (0, 0), 2.0)
    ramp = np.linspace(60, 180, WIDTH, dtype=np.float32)[None, :, None]
    picture: NDArray[np.uint8] = np.clip(102 * (discs() > 0.3)[..., None] + ramp + noise * 2, 0, 255).astype(np.uint8)
    return picture


def _psnr_db(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float(cv2.PSNR(np.ascontiguousarray(one), np.ascontiguousarray(other)))


def test_one_field_keeps_every_other_row() -> None:
    picture = _photograph()
    for rows in (HEIGHT, HEIGHT - 1):
        field = one_field(picture[:rows])
        np.testing.assert_array_equal(field[::2], picture[:rows:2])
        between = (picture[0 : rows - 2 : 2].astype(float) + picture[2:rows:2]) / 2
        np.testing.assert_allclose(field[1 : 1 + 2 * len(between) : 2], between, atol=0.5)


def test_an_overlay_tells_the_time_and_leaves_the_rest() -> None:
    picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    overlay = Overlay(is_timecoded=True, has_crosshair=True, has_frame=True)
    drawn = draw_overlay(picture, overlay, 12.04)
    changed = (drawn != picture).any(axis=-1)
    assert 0.005 < changed.mean() < 0.1
    assert not np.array_equal(drawn, draw_overlay(picture, overlay, 12.08))
    assert (picture == 90).all()
