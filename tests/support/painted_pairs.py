"""Stereo pairs drawn without the project's projection code: each sample of a pixel asks where its ray meets a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import MarkerLayout
from drogue_models.parameters import DrogueParameters, even_ring
from drogue_models.presets import PRESETS
from geometry.circles import ellipse_center_points, project_disc_centers
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, angles_from_axis, exp_twist, log_twist, rotation_from_angles
from geometry.stereo import EYES, StereoRig, paper_rig
from nav.pose.pose_method import Observation

SAMPLES = 8
READ_NOISE_DN = 1.0
FULL_WELL_E = 11_700.0

SKY_RGB = (95.0, 120.0, 160.0)
CLOUD_RGB = (205.0, 208.0, 212.0)
BROWN_RGB = (80.0, 62.0, 45.0)
GREEN_RGB = (48.0, 66.0, 30.0)
FACE_RGB = (7.0, 7.0, 7.0)


def make_pose(
    x_m: float, y_m: float, z_m: float, pitch_deg: float = 0, yaw_deg: float = 0, roll_deg: float = 0
) -> RigidTransform:
    """left_from_drogue by its place and its angles."""
    return RigidTransform(rotation_from_angles(*np.radians([pitch_deg, yaw_deg, roll_deg])), np.array([x_m, y_m, z_m]))


def background(rig: StereoRig, kind: str) -> np.ndarray:
    """(H, W, 3) sky; `cloud` adds bright bands, `ground` has brown and green fields below the middle row."""
    height, width = rig.camera.height_px, rig.camera.width_px
    v, u = np.mgrid[:height, :width].astype(np.float64)
    image = np.array(SKY_RGB) * (0.8 + 0.3 * v / height)[..., None]
    if kind == "cloud":
        share = 0.5 + 0.5 * np.sin(u / width * 23 + 2 * np.sin(v / height * 17))
        image += (np.array(CLOUD_RGB) - image) * (share**2)[..., None]
    if kind == "ground":
        fields = (np.floor(u * 9 / width) + np.floor(v * 9 / height)) % 2
        ground = np.where(fields[..., None] == 0, BROWN_RGB, GREEN_RGB)
        image = np.where((v > 0.4 * height)[..., None], ground, image)
    return image


def paint_disc(
    image: np.ndarray,
    rig: StereoRig,
    eye: str,
    place: RigidTransform,
    center: Sequence[float],
    edges: tuple[float, float],
    rgb: Sequence[float],
) -> None:
    """Paint an annulus (inner and outer radius `edges`) across the drogue's axis by every pixel's share."""
    camera = rig.camera
    offset = np.array([0.0 if eye == "left" else rig.baseline_m, 0.0, 0.0])
    origin = place.rotation @ np.asarray(center) + place.translation_m - offset
    inner, outer = edges
    u, v = np.array([camera.fx_px, camera.fy_px]) * origin[:2] / origin[2] + (camera.cx_px, camera.cy_px)
    reach = 1.2 * max(camera.fx_px, camera.fy_px) * outer / origin[2] + 3
    left, right = max(0, int(u - reach)), min(camera.width_px, int(u + reach) + 1)
    top, bottom = max(0, int(v - reach)), min(camera.height_px, int(v + reach) + 1)
    if left >= right or top >= bottom:
        return
    # Few samples for what has no centre to be measured, so that near drogues stay quick to draw.
    samples = SAMPLES if outer < 0.1 else 2
    sub = (np.arange(samples) + 0.5) / samples - 0.5
    x = ((np.arange(left, right)[:, None] + sub).ravel() - camera.cx_px) / camera.fx_px
    y = ((np.arange(top, bottom)[:, None] + sub).ravel() - camera.cy_px) / camera.fy_px
    n = place.rotation[:, 2]
    depth = (n @ origin) / (n[0] * x[None, :] + n[1] * y[:, None] + n[2])
    radius2 = (depth * x[None, :] - origin[0]) ** 2 + (depth * y[:, None] - origin[1]) ** 2 + (depth - origin[2]) ** 2
    inside = (radius2 <= outer**2) & (radius2 >= inner**2)
    share = inside.reshape(bottom - top, samples, right - left, samples).mean(axis=(1, 3))[..., None]
    part = image[top:bottom, left:right]
    part += (np.asarray(rgb, dtype=np.float64) - part) * share


def expose(image: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
    """8 bit with shot and read noise."""
    if rng is not None:
        electrons_per_dn = FULL_WELL_E / 255
        noise = np.sqrt(np.maximum(image, 0) / electrons_per_dn + READ_NOISE_DN**2 / 16)
        image = image + noise * rng.standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def paint_eye(
    rig: StereoRig,
    drogue: DrogueParameters | None,
    place: RigidTransform,
    eye: str,
    kind: str = "sky",
    marker_rgb: Sequence[float] = (150.0, 9.0, 9.0),
    hidden: Sequence[int] = (),
    extra_discs: Sequence[tuple[float, float, float, float]] = (),
) -> np.ndarray:
    """Radiance picture; `extra_discs` are (x, y, z, radius) in the drogue frame, painted like markers."""
    image = background(rig, kind)
    if drogue is None:
        return image
    paint_disc(image, rig, eye, place, (0, 0, 0.02), (0.0, drogue.rim_radius_m), FACE_RGB)
    if drogue.hub is not None:
        edges = (drogue.hub.inner_radius_m, drogue.hub.outer_radius_m)
        paint_disc(image, rig, eye, place, (0, 0, drogue.hub.depth_m), edges, marker_rgb)
    for index, (x, y) in enumerate(drogue.marker_positions_m):
        if index not in hidden:
            paint_disc(image, rig, eye, place, (x, y, 0), (0.0, drogue.marker_radius_m), marker_rgb)
    for x, y, z, radius in extra_discs:
        paint_disc(image, rig, eye, place, (x, y, z), (0.0, radius), marker_rgb)
    return image


def paint_pair(
    rig: StereoRig,
    drogue: DrogueParameters | None,
    place: RigidTransform,
    rng: np.random.Generator | None,
    kind: str = "sky",
    marker_rgb: Sequence[float] = (150.0, 9.0, 9.0),
    hidden: Sequence[int] = (),
    extra_discs: Sequence[tuple[float, float, float, float]] = (),
) -> StereoImages:
    """Both eyes' images, see `paint_eye`; without noise where there is no generator."""
    left, right = (
        expose(paint_eye(rig, drogue, place, eye, kind, marker_rgb, hidden, extra_discs), rng) for eye in EYES
    )
    return StereoImages(left, right, time_s=0.0, exposure_s=1e-3)


# A quarter of the seed paper's pixels behind half its focal length, so that whole flights are quick to draw.
FLIGHT_RIG = StereoRig(PinholeCamera(640, 480, 3200 / 3, 3200 / 3, 319.5, 239.5), 0.12)


def fly_past(places: Sequence[RigidTransform | None], times_s: Sequence[float] | None = None) -> list[BlindPair]:
    """Pairs of one drogue at these places, None where it is hidden; 25 a second unless told otherwise."""
    pairs = []
    for index, place in enumerate(places):
        drogue = None if place is None else PRESETS["red-8"]
        anywhere = make_pose(0, 0, 5) if place is None else place
        images = paint_pair(FLIGHT_RIG, drogue, anywhere, np.random.default_rng([77, index]))
        time_s = index / 25 if times_s is None else times_s[index]
        pairs.append(BlindPair(index, replace(images, time_s=time_s), FLIGHT_RIG, PRESETS["red-8"]))
    return pairs


@dataclass(frozen=True)
class Draws:
    """Measured ellipse centres of many poses: pixels (B, 2, F, 2), the markers and then the hub's two edges."""

    rig: StereoRig
    layout: MarkerLayout
    sigma_px: float
    places: list[RigidTransform]
    exact_px: np.ndarray
    pixels_px: np.ndarray

    def observation(self, index: int, hub: bool = True, pixels_px: np.ndarray | None = None) -> Observation:
        count = self.layout.count
        pixels = self.pixels_px[index] if pixels_px is None else pixels_px
        cov = np.broadcast_to(self.sigma_px**2 * np.eye(2), (*pixels.shape, 2))
        if not hub or pixels.shape[1] == count:
            return Observation(self.rig, self.layout, pixels[:, :count], cov[:, :count])
        return Observation(self.rig, self.layout, pixels[:, :count], cov[:, :count], pixels[:, count:], cov[:, count:])

    def errors(self, index: int, rotation: np.ndarray, translation_m: np.ndarray) -> np.ndarray:
        """(8,) errors in X, Y, Z [m], pitch, yaw [rad] and rotation vector [rad]."""
        true = self.places[index]
        angles = np.subtract(angles_from_axis(rotation[:, 2]), angles_from_axis(true.rotation[:, 2]))
        turn = log_twist(RigidTransform(rotation @ true.rotation.T, np.zeros(3)))[3:]
        return np.concatenate([translation_m - true.translation_m, angles, turn])

    def bounds(self, features: int) -> np.ndarray:
        """(B, 5) Cramer-Rao bounds of X, Y, Z [m], pitch and yaw [rad] by differences of the exact projection.

        Args:
            features: how many of them count, the markers first.
        """
        steps = 1e-6 * np.concatenate([np.eye(6), -np.eye(6)])
        turns = np.array([exp_twist([0, 0, 0, *step[3:]]).rotation for step in steps])
        # (B, 12, ...): every pose, moved by every step.
        rotations = turns @ np.array([place.rotation for place in self.places])[:, None]
        translations = np.array([place.translation_m for place in self.places])[:, None] + steps[:, :3]
        centers, radii = (each[:features] for each in drogue_features(self.layout))
        centers_m, axes = centers @ np.swapaxes(rotations, 2, 3) + translations[:, :, None], rotations[:, :, None, :, 2]
        pixels = [
            self.rig.camera.project(ellipse_center_points(centers_m - self.rig.eye_offset_m(eye), axes, radii))
            for eye in EYES[: self.exact_px.shape[1]]
        ]
        seen = np.stack(pixels, axis=2).reshape(len(self.places), len(steps), -1)
        derived = np.concatenate([translations, np.stack(angles_from_axis(rotations[..., 2]), axis=-1)], axis=-1)
        jacobian, outputs = ((each[:, :6] - each[:, 6:]) / 2e-6 for each in (seen, derived))
        covariance = np.swapaxes(outputs, 1, 2) @ np.linalg.inv(jacobian @ np.swapaxes(jacobian, 1, 2)) @ outputs
        return self.sigma_px * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def drogue_features(layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Centres and radii of the markers and of the hub's inner and outer edge. [m]"""
    radii = np.full(layout.count, layout.radius_m)
    if layout.hub_center_m is None:
        return layout.centers_m, radii
    centers = np.vstack([layout.centers_m, layout.hub_center_m, layout.hub_center_m])
    return centers, np.append(radii, [layout.hub_inner_radius_m, layout.hub_outer_radius_m])


def draw_poses(
    rng: np.random.Generator,
    count: int,
    z_m: float | tuple[float, float],
    sigma_px: float,
    markers: int = 8,
    tilt_deg: tuple[float, float] = (0.0, 10.0),
    ring_sigma_m: float = 0.0,
) -> Draws:
    """Poses with pitch and yaw of random signs, with the ring of 0.28 m for which the published figures hold."""
    rig = paper_rig()
    centers = np.column_stack([np.array(even_ring(markers, 0.28)), np.zeros(markers)])
    layout = MarkerLayout(centers, 0.05, np.array([0.0, 0.0, 0.25]), 0.05, 0.075)
    places, exact = [], []
    for _ in range(count):
        depth = z_m if isinstance(z_m, float) else rng.uniform(*z_m)
        tilts = rng.uniform(*tilt_deg, 2) * rng.choice([-1, 1], 2)
        x, y = rng.uniform(-0.03, 0.03, 2) * depth
        places.append(make_pose(0.06 + x, y, depth, *tilts, rng.uniform(-22.5, 22.5)))
        points, radii = drogue_features(layout)
        points = points * np.append(np.full(markers, 1 + ring_sigma_m / 0.28 * rng.standard_normal()), [1, 1])[:, None]
        exact.append([project_disc_centers(rig, places[-1], points, radii, eye) for eye in EYES])
    exact_px = np.array(exact)
    noise = sigma_px * rng.standard_normal(exact_px.shape)
    return Draws(rig, layout, sigma_px, places, exact_px, exact_px + noise)
