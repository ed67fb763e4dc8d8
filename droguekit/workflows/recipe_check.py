"""What a recipe's markers will look like and how well they can be measured, computed before anything is rendered.

Light, exposure and noise are those of the generator: the environment of the recipe's first scene with the sun by day,
at dusk and at night, the exposure law, and the sensor. The drogue faces the cameras on their axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import Recipe
    from datasets_manifest.types.environment import Environment
    from datasets_manifest.types.frame import Exposure
    from geometry.se3 import Array

SCHEMA = 1
# Elevations of the sun. At the third one the sun gives no light; a moon is left out.
LIGHTS = {"day": 35.0, "dusk": -4.0, "night": -18.0}
_DISTANCES = 9
# A small marker's place can be fitted from here on; peaks of this strength stand out of a box's noise.
LEAST_SNR = 5.0
# Where a light disc lies in its pixel: a regular pattern, for means over it.
_PHASES = np.stack(np.meshgrid([-0.375, -0.125, 0.125, 0.375], [-0.375, -0.125, 0.125, 0.375]), axis=-1).reshape(-1, 2)
_SPARE_PX, _CELLS = 4, 8
# A disc up to this radius lies within one pixel, and its place is known to so much before anything is measured.
_WITHIN_PIXEL_RADIUS_PX, _WITHIN_PIXEL_SIGMA_PX = 0.5, 0.2
_SMALLEST_RADIUS_PX, _LEAST_GAP_PX, _LEAST_BOX_PX = 0.3, 3.0, 16.0
_MOST_CLIPPED = 0.95
# Lamps are sought between these, by steps of a factor of 3, and then to 2 %.
_LUMINANCES_CD_M2, _LADDER, _HALVINGS = (1e-4, 1e6), 22, 6


@dataclass(frozen=True)
class MarkerPrediction:
    """A marker at one distance in one light.

    Attributes:
        light: `day`, `dusk` or `night`.
        distance_m: of the drogue.
        radius_px: of the marker's image.
        gap_px: between neighbouring markers' images; None of a single marker.
        rim_px: diameter of the rim's image.
        contrast: light of the marker above that beside it, over that beside it.
        snr: light of the marker over the noise of a fit.
        clipped_fraction: share of the marker's light in pixels above the sensor's range.
        centroid_sigma_px: Cramer-Rao bound of a centre, per axis; None where a marker is not seen: without contrast, or
            below `LEAST_SNR`.
        x_sigma_m, z_sigma_m: bound of the position across and along the line of sight, by both eyes; None where open.
        pitch_sigma_deg: bound of the attitude; None where open.
    """

    light: str
    distance_m: float
    radius_px: float
    gap_px: float | None
    rim_px: float
    contrast: float
    snr: float
    clipped_fraction: float
    centroid_sigma_px: float | None
    x_sigma_m: float | None
    z_sigma_m: float | None
    pitch_sigma_deg: float | None


@dataclass(frozen=True)
class LightPrediction:
    """The light of a scene and the exposure that the recipe's law takes for it.

    Attributes:
        light: `day`, `dusk` or `night`.
        sun_elevation_deg: of the sun; None where an environment map shows none.
        sky_cd_m2, face_cd_m2, marker_cd_m2: luminance in the direction of the drogue, of the face and of a marker; for
            a sensor behind an infrared filter the light in its band, in units of sunlight.
        exposure_s, gain: of both eyes.
    """

    light: str
    sun_elevation_deg: float | None
    sky_cd_m2: float
    face_cd_m2: float
    marker_cd_m2: float
    exposure_s: float
    gain: float


@dataclass(frozen=True)
class RecipeCheck:
    """All predictions of a recipe.

    Attributes:
        name: of the recipe.
        lights: by day, at dusk and at night.
        markers: in each light, from near to far.
        advice: what will fail and what to change, a sentence each.
    """

    name: str
    lights: tuple[LightPrediction, ...]
    markers: tuple[MarkerPrediction, ...]
    advice: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """The content of the JSON file."""
        return {"schema": SCHEMA, **asdict(self)}

    def of_light(self, light: str) -> list[MarkerPrediction]:
        """The predictions in one light, from near to far."""
        return [each for each in self.markers if each.light == light]


def check_recipe(recipe: Recipe) -> RecipeCheck:
    """Predict what a recipe's markers will look like, and how well they can be measured.

    Raises:
        ValueError: a recipe of a calibration board, or whose drogue has no markers.
    """
    from drogue_models.marker_layout import marker_layout

    if recipe.board is not None:
        raise ValueError("check: the recipe shows a calibration board and no drogue")
    if marker_layout(recipe.drogue).count == 0:
        raise ValueError(
            f"check: the drogue {recipe.drogue.name} has no markers to predict; the method joint-rim takes its pose "
            "from the rim where it stands dark before the sky"
        )
    recipe = with_drogue_in_all_pairs(recipe)
    scenes = dict(_scenes(recipe))
    lights = tuple(scene.told(light) for light, scene in scenes.items())
    markers = tuple(
        _predict(recipe, scene, light, distance_m)
        for light, scene in scenes.items()
        for distance_m in _distances(recipe)
    )
    check = RecipeCheck(recipe.name, lights, markers, ())
    return replace(check, advice=tuple(_advice(recipe, check, scenes)))


def with_drogue_in_all_pairs(recipe: Recipe) -> Recipe:
    """The recipe without its empty pairs, which have no markers to look at."""
    return recipe.model_copy(update={"frames": recipe.frames.model_copy(update={"empty_fraction": 0.0})})


def check_lines(check: RecipeCheck) -> Iterator[str]:
    """The predictions as a table, and what will fail."""
    yield f"{check.name}: predicted, with the drogue on the cameras' axis"
    for light in check.lights:
        sun = "no sun" if light.sun_elevation_deg is None else f"sun at {light.sun_elevation_deg:g} deg"
        yield (
            f"{light.light}: {sun}, sky {light.sky_cd_m2:.3g} cd/m2, face "
            f"{light.face_cd_m2:.3g}, markers {light.marker_cd_m2:.3g}; exposure {1e3 * light.exposure_s:.3g} ms, "
            f"gain {light.gain:g}"
        )
        heads = ("m", "radius px", "contrast", "SNR", "clipped", "centre px", "x mm", "z mm", "pitch deg")
        yield "  " + "".join(f"{head:>10}" for head in heads)
        for row in check.of_light(light.light):
            cells = (
                row.distance_m,
                row.radius_px,
                row.contrast,
                row.snr,
                row.clipped_fraction,
                row.centroid_sigma_px,
                None if row.x_sigma_m is None else 1e3 * row.x_sigma_m,
                None if row.z_sigma_m is None else 1e3 * row.z_sigma_m,
                row.pitch_sigma_deg,
            )
            yield "  " + "".join(f"{'-' if cell is None else f'{cell:.3g}':>10}" for cell in cells)
    yield "what will fail, and what to change:" if check.advice else "nothing will fail by these predictions"
    yield from (f"  {sentence}" for sentence in check.advice)


def _distances(recipe: Recipe) -> list[float]:
    if recipe.distance.stations_m is not None:
        return sorted(set(recipe.distance.stations_m))
    low, high = recipe.distance.low_m, recipe.distance.high_m
    assert low is not None
    assert high is not None
    return [low] if low == high else [round(float(each), 3) for each in np.geomspace(low, high, _DISTANCES)]


@dataclass(frozen=True, eq=False)
class _Scene:
    """Light in one environment, as (3,) radiances [cd/m2], and the sensor's band [nm] or None.

    Markers show their lamps' light and that on their paint; `unit_lamp` is the light of lamps of 1 cd/m2.
    """

    environment: Environment
    exposure: Exposure
    band_nm: float | None
    sky: Array
    face: Array
    paint: Array
    lamp: Array
    unit_lamp: Array

    @property
    def marker(self) -> Array:
        """(3,) light of a marker. [cd/m2]"""
        light: Array = self.lamp + self.paint
        return light

    def with_lamps(self, luminance_cd_m2: float) -> _Scene:
        """The same with other lamps, or with lamps where there are none."""
        return replace(self, lamp=luminance_cd_m2 * self.unit_lamp)

    def told(self, light: str) -> LightPrediction:
        from scenes.environment_radiance import sun_elevation_deg
        from scenes.sky.photometry import light_in_band

        sky, face, marker = (float(light_in_band(each, self.band_nm)) for each in (self.sky, self.face, self.marker))
        elevation_deg = sun_elevation_deg(self.environment)
        return LightPrediction(light, elevation_deg, sky, face, marker, self.exposure.time_s, self.exposure.gain)


def _scenes(recipe: Recipe) -> Iterator[tuple[str, _Scene]]:
    """The first scene's environment by day, at dusk and at night; one with an environment map has the map's light."""
    from drogue_models.parts import FIRST_MARKER_ID
    from render.surfaces import lamp_radiance_rgb
    from scenes.environment_radiance import environment_radiance
    from scenes.sampler import automatic_exposure, recipe_of_scene, sample_frame, scene_of_frame
    from scenes.sky.photometry import luminance

    own, frame = recipe_of_scene(recipe, scene_of_frame(recipe, 0)), sample_frame(recipe, 0)
    mapped = frame.environment.map is not None
    for light, elevation_deg in {"map": frame.environment.sun_elevation_deg}.items() if mapped else LIGHTS.items():
        changes: dict[str, object] = {} if mapped else {"sun_elevation_deg": elevation_deg, "clouds": (), "moon": None}
        environment = frame.environment.model_copy(update=changes)
        ambient, camera = environment_radiance(environment), recipe.rig.camera
        exposure = automatic_exposure(own.exposure, environment, camera, frame.world_from_left, recipe.sensor)
        ahead = frame.world_from_left.rotation[:, 2]
        lux = ambient.plate_illuminance_lux(-ahead)
        sky = ambient.radiance(ahead.astype(np.float32).reshape(1, 1, 3))[0, 0].astype(np.float64)
        drogue = recipe.drogue
        behind = drogue.face_reflectance_rgb if drogue.body is None else drogue.canopy_reflectance_rgb
        lamp = lamp_radiance_rgb(frame, FIRST_MARKER_ID)
        color = np.array(drogue.marker_emission_rgb)
        unit = lamp / drogue.marker_luminance_cd_m2 if lamp.any() else color / max(float(luminance(color)), 1e-9)
        face, paint = (np.array(each) * lux / np.pi for each in (behind, drogue.marker_reflectance_rgb))
        yield light, _Scene(environment, exposure, recipe.sensor.band_nm, sky, face, paint, lamp, unit)


def _predict(recipe: Recipe, scene: _Scene, light: str, distance_m: float) -> MarkerPrediction:
    from drogue_models.marker_layout import marker_layout
    from droguekit.scoring.poses.cramer_rao import FeatureNoise, features_seen, pose_bound
    from geometry.se3 import RigidTransform
    from nav.centroids.binary_centroids import smallest_gap_m

    layout, rig = marker_layout(recipe.drogue), recipe.rig
    scale = rig.delivered_focal_px / distance_m
    radius_px = layout.radius_m * scale
    contrast, snr, clipped, sigma_px = _marker_light(recipe, scene, scale)
    bound = None
    if sigma_px is not None:
        middle = np.array([rig.baseline_m / 2, 0.0, distance_m])
        # Head on, the two tilts are at their worst; a turn of a degree keeps the bound finite.
        pose = RigidTransform(np.eye(3), middle)
        noise = FeatureNoise(sigma_px, sigma_px)
        bound = pose_bound(rig, pose, layout, features_seen(layout, hub=False), noise)
    x_m, _, z_m, pitch_deg, _ = (None,) * 5 if bound is None else (float(each) for each in bound)
    gap_px = smallest_gap_m(layout) * scale if layout.count > 1 else None
    rim_px = 2 * recipe.drogue.rim_radius_m * scale
    return MarkerPrediction(
        light, distance_m, radius_px, gap_px, rim_px, contrast, snr, clipped, sigma_px, x_m, z_m, pitch_deg
    )


def _marker_light(recipe: Recipe, scene: _Scene, scale_px_per_m: float) -> tuple[float, float, float, float | None]:
    """Contrast, signal to noise, clipped share and the bound of the centre, over all places within a pixel. [px]"""
    from drogue_models.marker_layout import marker_layout
    from nav.centroids.disc_coverage import spread_discs
    from render.camera.sensor import dn_per_electron, mono_weights

    sensor, layout = recipe.sensor, marker_layout(recipe.drogue)
    radius_px = layout.radius_m * scale_px_per_m
    half = int(np.ceil(min(radius_px, 40.0))) + _SPARE_PX
    size = np.full(len(_PHASES), min(radius_px, 40.0))
    drawn = spread_discs(_PHASES, size, np.full(len(_PHASES), sensor.psf_sigma_px), half, 1)
    on_face = _share_of_face(recipe, scale_px_per_m, half, sensor.psf_sigma_px)
    electrons = sensor.electrons_per_cd_m2(scene.exposure)
    colors = mono_weights(sensor.band_nm) if sensor.color == "mono" else np.eye(3)
    # A mosaic measures one colour a pixel: a quarter, a half and a quarter of the pixels.
    shares = np.array([0.25, 0.5, 0.25]) if sensor.color == "bayer" else np.ones(len(colors))
    step_e = 2.0 ** (sensor.adc_bits - sensor.output_bits) / dn_per_electron(sensor, scene.exposure.gain)
    full_e = min(sensor.full_well_e, sensor.full_well_e / scene.exposure.gain)
    information, light2, clipped, whole = np.zeros((len(_PHASES), 2)), np.zeros(len(_PHASES)), 0.0, 0.0
    beside = above = 0.0
    for weights, share in zip(colors, shares, strict=True):
        marker_e, face_e, sky_e = (electrons * float(weights @ each) for each in (scene.marker, scene.face, scene.sky))
        behind_e = on_face * face_e + (1 - on_face) * sky_e
        mean_e = behind_e + (marker_e - face_e) * drawn.light
        noise2 = mean_e + sensor.read_noise_e**2 + (sensor.prnu_fraction * mean_e) ** 2 + step_e**2 / 12
        open_ = mean_e < full_e
        gain_e = marker_e - face_e
        for axis, slope in enumerate((drawn.by_x, drawn.by_y)):
            information[:, axis] += share * ((gain_e * slope) ** 2 * open_ / noise2).sum(axis=(1, 2))
        light2 += share * ((gain_e * drawn.light) ** 2 * open_ / noise2).sum(axis=(1, 2))
        clipped += share * float((drawn.light * ~open_).sum())
        whole += share * float(drawn.light.sum())
        own = drawn.light / drawn.light.sum(axis=(1, 2), keepdims=True)
        beside += share * float((own * behind_e).sum(axis=(1, 2)).mean())
        above += share * float((own * (mean_e - behind_e)).sum(axis=(1, 2)).mean())
    contrast = above / max(beside, 1e-9)
    snr = float(np.sqrt(light2).mean())
    if contrast <= 0 or snr < LEAST_SNR:
        return contrast, snr, clipped / whole, None
    known = _WITHIN_PIXEL_SIGMA_PX**-2 if radius_px < _WITHIN_PIXEL_RADIUS_PX else 0.0
    sigma_px = float(np.sqrt((1 / (information + known)).mean()))
    return contrast, snr, clipped / whole, sigma_px


def _share_of_face(recipe: Recipe, scale_px_per_m: float, half: int, sigma_px: float) -> Array:
    """(W, W) share of each pixel that the face fills around a marker at the right; all of it for a body."""
    from scipy.ndimage import gaussian_filter

    drogue = recipe.drogue
    size = 2 * half + 1
    if drogue.body is not None:
        return np.ones((size, size))
    at = (np.arange(size * _CELLS) + 0.5) / _CELLS - half - 0.5
    out_px = float(np.mean([np.hypot(x, y) for x, y in drogue.marker_positions_m])) * scale_px_per_m
    away_px = np.hypot(at + out_px, at[:, None])
    inner_px, outer_px = drogue.face_inner_radius_m * scale_px_per_m, drogue.rim_radius_m * scale_px_per_m
    face = ((away_px > inner_px) & (away_px < outer_px)).reshape(size, _CELLS, size, _CELLS).mean(axis=(1, 3))
    share: Array = gaussian_filter(face, sigma_px, mode="nearest")
    return share


def _advice(recipe: Recipe, check: RecipeCheck, scenes: dict[str, _Scene]) -> Iterator[str]:
    """What will fail by the predictions, and what to change."""
    drogue, near = recipe.drogue, check.of_light(check.lights[0].light)
    if drogue.marker_count < 4:
        yield f"{drogue.marker_count} markers leave no spare one: give the drogue at least 4, better 6"
    small = [row.distance_m for row in near if row.radius_px < _SMALLEST_RADIUS_PX]
    if small:
        needed_m = np.ceil(1e3 * _SMALLEST_RADIUS_PX * near[-1].distance_m / recipe.rig.delivered_focal_px) / 1e3
        yield (
            f"markers are below {_SMALLEST_RADIUS_PX} px radius from {small[0]:.3g} m on: use a radius of "
            f"{needed_m:.2g} m, a longer lens, or by day the method joint-rim, which measures the rim"
        )
    close = [row.distance_m for row in near if row.gap_px is not None and row.gap_px < _LEAST_GAP_PX]
    if close:
        yield f"neighbouring markers merge from {close[0]:.3g} m on, {_LEAST_GAP_PX:g} px apart: use fewer of them"
    tiny = [row.distance_m for row in near if row.rim_px < _LEAST_BOX_PX]
    if tiny:
        yield (
            f"the rim is below {_LEAST_BOX_PX:g} px from {tiny[0]:.3g} m on, where detectors begin to miss it: use a "
            "longer lens, or expect no box there"
        )
    for light in check.lights:
        yield from _advice_in(recipe, light, check.of_light(light.light), scenes[light.light])
    if recipe.sensor.output_bits == 12:
        yield (
            "images have 12 bits in files of 16, which most viewers show as black: look at them with `preview` or "
            "`browse`, or write copies with `export --format coco --images`"
        )


def _advice_in(recipe: Recipe, light: LightPrediction, rows: list[MarkerPrediction], scene: _Scene) -> Iterator[str]:
    lit = recipe.drogue.marker_luminance_cd_m2
    name = "lamps" if lit else "markers"
    when = {"day": "by day", "dusk": "at dusk", "night": "at night"}.get(light.light, "in this light")

    def enough(failing: list[MarkerPrediction]) -> str:
        """What suffices at all these distances: near markers ask for less light, or clip earlier."""
        least_cd_m2 = [
            _least_luminance(recipe, scene, recipe.rig.delivered_focal_px / row.distance_m) for row in failing
        ]
        known = [each for each in least_cd_m2 if each is not None]
        return f"{'' if lit else 'lamps of '}{_text(_rounded(max(known)))} cd/m2" if len(known) == len(failing) else ""

    dark = [row for row in rows if row.contrast <= 0]
    if dark:
        infrared = "infrared lamps and a filter (rig preset mono-850)" if recipe.sensor.band_nm is None else ""
        uses = [use for use in (enough(dark), infrared) if use]
        yield (
            f"{name} are darker than what is beside them {when} from {dark[0].distance_m:.3g} m on: use "
            f"{' or '.join(uses) or 'brighter lamps'}"
        )
    faint = [row for row in rows if row.contrast > 0 and row.snr < LEAST_SNR]
    if faint:
        uses = [use for use in (enough(faint), "a wider aperture") if use]
        yield (
            f"{name} are below {LEAST_SNR:g} deviations of the noise {when} from {faint[0].distance_m:.3g} m on: use "
            f"{', '.join(uses)} or a longer exposure"
        )
    clipped = [row for row in rows if row.clipped_fraction > _MOST_CLIPPED]
    if clipped:
        yield (
            f"{name} are brighter than the sensor's range {when} up to {clipped[-1].distance_m:.3g} m: shorten "
            "exposure.auto_time_s"
        )


def _least_luminance(recipe: Recipe, scene: _Scene, scale_px_per_m: float) -> float | None:
    """Luminance from which on lamps stand out of the noise in a scene, or None where none does. [cd/m2]"""

    def stands_out(luminance_cd_m2: float) -> bool:
        contrast, snr, _, _ = _marker_light(recipe, scene.with_lamps(luminance_cd_m2), scale_px_per_m)
        return contrast > 0 and snr >= LEAST_SNR

    # Far brighter lamps are clipped and tell nothing again: the first step that suffices is sought from below.
    ladder = np.geomspace(*_LUMINANCES_CD_M2, _LADDER)
    first = next((k for k, step in enumerate(ladder) if stands_out(float(step))), None)
    if first is None:
        return None
    low, high = float(ladder[max(first - 1, 0)]), float(ladder[first])
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if stands_out(middle) else (middle, high)
    return high


def _rounded(luminance_cd_m2: float) -> float:
    """Two figures, upwards."""
    step = 10.0 ** (math.floor(math.log10(max(luminance_cd_m2, 1e-9))) - 1)
    return math.ceil(luminance_cd_m2 / step) * step


def _text(luminance_cd_m2: float) -> str:
    return f"{luminance_cd_m2:,.0f}" if luminance_cd_m2 >= 100 else f"{luminance_cd_m2:.2g}"
