"""Method `joint-rim`: the pose that best explains the edge of the rim in both eyes, without any marker.

The outline of the rim's tube is that of a circle of known radius, so both images give position, pitch and yaw; the roll
about the axis leaves no trace. An edge that light or lens move outwards alike everywhere looks like a larger rim: that
shift is an unknown with a prior, and the disparity weighs against the size. As for markers, a circle far away allows
two tilts; see `nav.pose.joint` for the pose where both remain.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import RimOutline
from geometry.se3 import Array, RigidTransform, exp_rotation, skew
from geometry.stereo import EYES, StereoRig
from nav.pose.joint import RELIABLE_SIGMAS, TILT_PRIOR_RAD
from nav.pose.marker_geometry import rotations_from_axes
from nav.pose.pose_method import NoFixReason, Observation, PoseMode, RimEdges, Solution
from nav.pose.tilt_pairs import TiltPairs, line_of_sight_rotations, mixture_mean, mode_weights

# Standard deviation of an angle of which nothing is known. [rad]
ROLL_SD_RAD = np.pi / np.sqrt(3)
EDGE_SHIFT_SD_PX = np.array([0.1, 0.03, 0.03, 0.03, 0.03, 0.03])
"""Standard deviations of what moves edges outwards: in both eyes alike, in the right one beyond the left one, and in
both by the cosine and sine of the angle about the axis and of its double. Measured on path-traced drogues. [px]"""
_SHIFT_INFORMATION = np.diag(EDGE_SHIFT_SD_PX**-2)
# As if nothing were known of what all edges share.
_FREE_SHIFT_INFORMATION = np.diag(EDGE_SHIFT_SD_PX**-2 * [1e-6, 1, 1, 1, 1, 1])
_PARAMETERS = 6 + len(EDGE_SHIFT_SD_PX)
# Share of the circumference on which an edge must be seen, and on which it must agree with the rest, in each eye.
_LEAST_SEEN, _LEAST_AGREEING = 0.6, 0.5
_FEWEST_POINTS = 8
# A rim that is lit has no edge of its own: its light, and that of the canopy behind it, move the edge by whole pixels.
# Of drogues whose edge is at least this dark against the sky, errors are as stated.
LEAST_DARKNESS = 0.8
# Starts tilt by at least this much, so that there are two of them.
_LEAST_START_RAD = np.radians(4.0)
_STEPS, _SMALL_STEP_PX = 25, 1e-4
# Tukey's biweight: points this many standard deviations away do not count, nearer ones by degrees.
_TUKEY_SIGMAS = 4.7
# Scatter of the points about the outline above which it is another one, and the shift above which it is another circle.
_LARGEST_SCATTER_PX = 0.5
_LARGEST_SHIFT_PX, _SHIFT_SIGMAS = 0.35, 4.0
# Where something behind the rim may reach further out than this, the edge need not be the rim's. [px]
_LARGEST_BULGE_PX = 0.1


def joint_rim(observation: Observation) -> Solution | NoFixReason:
    """Method `joint-rim`: least squares over the edge points of the rim in both eyes.

    The covariance counts the scatter of the points about the outline. Its part along the roll is that of an angle of
    which nothing is known.
    """
    rim, edges = observation.layout.rim, observation.rim
    reason = _fault(rim, edges)
    if reason is not None:
        return reason
    assert rim is not None
    assert edges is not None
    starts = _starts(observation.rig, rim, edges)
    if isinstance(starts, NoFixReason):
        return starts
    # The radius first comes out as it is, so that another circle shows by its disparity.
    free = replace(_Problem(observation.rig, rim, edges), shift_information=_FREE_SHIFT_INFORMATION)
    fits = [free.adjust(start, None) for start in starts]
    reason = _misfit(free, min(fits, key=lambda fit: fit.unlikelihood(edges.sigma_px)))
    if reason is not None:
        return reason
    problem = replace(free, shift_information=_SHIFT_INFORMATION)
    fits = [problem.adjust(fit.pose, None) for fit in fits]
    best = min(fits, key=lambda fit: fit.unlikelihood(edges.sigma_px))
    # Both tilts with the weights of the better one, so that their costs compare.
    fits = [problem.adjust(fit.pose, best) for fit in fits]
    return _solution(observation, problem, fits, best)


def _fault(rim: RimOutline | None, edges: RimEdges | None) -> NoFixReason | None:
    if rim is None:
        return NoFixReason("the rim of the drogue is not known")
    if not rim.is_known:
        return NoFixReason("the drogue's outline may not be its rim: it has a mesh of its own or an inflated canopy")
    if edges is None:
        return NoFixReason("no edge of the rim was measured: this method needs images")
    for eye, seen, darkness in zip(EYES, edges.seen_fraction, edges.darkness, strict=True):
        if seen < _LEAST_SEEN or (edges.eyes == EYES.index(eye)).sum() < _FEWEST_POINTS:
            return NoFixReason(
                f"the {eye} image shows the rim's edge on {100 * seen:.0f} % of its circumference, "
                f"{100 * _LEAST_SEEN:.0f} % are needed"
            )
        if darkness < LEAST_DARKNESS:
            light, most = 100 * (1 - darkness), 100 * (1 - LEAST_DARKNESS)
            return NoFixReason(
                f"the drogue is no dark silhouette in the {eye} image, and light on it moves its edge: it has "
                f"{light:.0f} % of the background's light, {most:.0f} % are allowed"
            )
    return None


@dataclass(frozen=True, eq=False)
class _Fit:
    """An adjusted pose.

    Attributes:
        pose: with roll zero.
        shift_px: (6,) of the edges outwards, see `EDGE_SHIFT_SD_PX`.
        residuals_px: (K,) of the points outwards.
        weights: (K,) their information times their robust weights. [1/px^2]
        trust: (K,) robust weights from 0 to 1.
        scatter_px: what points scatter beyond their own deviations.
        cost: half the sum of squares in standard deviations, priors included.
        normal: (12, 12) normal equations of pose and shifts, without priors.
    """

    pose: RigidTransform
    shift_px: Array
    residuals_px: Array
    weights: Array
    trust: Array
    scatter_px: float
    cost: float
    normal: Array

    def unlikelihood(self, sigma_px: Array) -> float:
        """Minus the logarithm of the likelihood, for fits that each found a scatter of their own."""
        return self.cost + float(np.log(sigma_px**2 + self.scatter_px**2).sum()) / 2

    def information(self, common: float) -> Array:
        """(6, 6) of the pose, with the roll's; that of the points is divided by `common`."""
        return _pose_information(self.normal / common, self.pose)


def _roll_information(pose: RigidTransform) -> Array:
    axis = np.concatenate([np.zeros(3), pose.rotation[:, 2]])
    information: Array = np.outer(axis, axis) / ROLL_SD_RAD**2
    return information


@dataclass(frozen=True, eq=False)
class _Problem:
    """The edge points of one pair, the rim whose outline they are, and the (6, 6) prior information of the shifts."""

    rig: StereoRig
    rim: RimOutline
    edges: RimEdges
    shift_information: Array = field(default_factory=lambda: _SHIFT_INFORMATION)

    @property
    def eyes_m(self) -> Array:
        """(K, 3) centre of each point's eye in the left camera. [m]"""
        return np.stack([self.rig.eye_offset_m(eye) for eye in EYES])[self.edges.eyes]

    def angles(self, pose: RigidTransform) -> Array:
        """(K,) where on the circle of the tube the points lie. [rad]"""
        rays = self.rig.camera.rays(self.edges.points_px)
        axis = pose.rotation[:, 2]
        middle = pose.translation_m + self.rim.tube_radius_m * axis
        length = ((middle - self.eyes_m) @ axis) / (rays @ axis)
        x, y, _ = ((self.eyes_m + length[:, None] * rays - pose.translation_m) @ pose.rotation).T
        angles: Array = np.arctan2(y, x)
        return angles

    def linearised(self, pose: RigidTransform) -> tuple[Array, Array, NDArray[np.bool_]]:
        """(K,) residuals [px], their (K, 12) derivatives by pose and shifts, and whether (K,) nothing else may show."""
        angles = self.angles(pose)
        tube_m = _facing_points_m(self.rim, pose, angles, self.eyes_m)
        places, normals = outline_points(self.rig, self.rim, pose, angles, self.eyes_m)
        residuals = ((self.edges.points_px - places) * normals).sum(axis=1)
        slopes = np.ones((len(residuals), _PARAMETERS))
        # An outline moves across itself as the points of the tube do that lie on it.
        across = self._across_per_m(tube_m, normals)
        slopes[:, :3] = across
        slopes[:, 3:6] = np.cross(tube_m + self.eyes_m - pose.translation_m, across)
        slopes[:, 7] = self.edges.eyes - 0.5
        slopes[:, 8:] = np.stack([np.cos(angles), np.sin(angles), np.cos(2 * angles), np.sin(2 * angles)], axis=-1)
        return residuals, slopes, self._is_rim(pose, angles, places, normals)

    def _across_per_m(self, points_m: Array, normals: Array) -> Array:
        """(K, 3) how far images of points, given from their eyes, move along the normals. [px/m]"""
        camera = self.rig.camera
        scaled = normals * np.array([camera.fx_px, camera.fy_px]) / points_m[:, 2:]
        toward = -(scaled * points_m[:, :2]).sum(axis=1, keepdims=True) / points_m[:, 2:]
        return np.concatenate([scaled, toward], axis=1)

    def _is_rim(self, pose: RigidTransform, angles: Array, places: Array, normals: Array) -> NDArray[np.bool_]:
        """(K,) where nothing behind the rim can reach beyond its outline."""
        is_rim = np.ones(len(angles), dtype=bool)
        for radius_m, depth_m in self.rim.bulges_m:
            circle = np.stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.full(len(angles), depth_m)], -1)
            beyond = self.rig.camera.project(pose.apply(circle) - self.eyes_m) - places
            is_rim &= (beyond * normals).sum(axis=1) < _LARGEST_BULGE_PX
        return is_rim

    def adjust(self, start: RigidTransform, weighted: _Fit | None, tilt_prior_rad: float = np.inf) -> _Fit:
        """The pose by steps of Gauss, Newton, Levenberg and Marquardt.

        Args:
            start: its roll does not count.
            weighted: takes the weights of the points from there; by default robust ones that settle.
            tilt_prior_rad: standard deviation of the axis's parts across the optical axis.
        """
        pose, shift, damping = without_roll(start), np.zeros(len(EDGE_SHIFT_SD_PX)), 1e-3
        residuals, slopes, is_rim = self.linearised(pose)
        weights, trust, scatter = self._weights(residuals, is_rim, weighted)
        cost = self._cost(residuals - slopes[:, 6:] @ shift, shift, weights, pose, tilt_prior_rad)
        for _ in range(_STEPS):
            normal, gradient = self._equations(residuals, slopes, shift, weights, pose, tilt_prior_rad)
            # Where no point counts, nothing moves.
            scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-12))
            scaled = normal * np.outer(scale, scale) + damping * np.eye(_PARAMETERS)
            step = scale * np.linalg.solve(scaled, scale * gradient)
            turned = exp_rotation(step[3:6]) @ pose.rotation
            trial, trial_shift = without_roll(RigidTransform(turned, pose.translation_m + step[:3])), shift + step[6:]
            moved_px = float(np.abs(slopes[:, :6] @ step[:6]).max())
            if not (trial.translation_m[2] > 2 * self.rim.radius_m and trial.rotation[2, 2] > 0.2):
                damping *= 10
                continue
            new = self.linearised(trial)
            new_cost = self._cost(new[0] - slopes[:, 6:] @ trial_shift, trial_shift, weights, trial, tilt_prior_rad)
            if new_cost <= cost * (1 + 1e-9):
                pose, shift, (residuals, slopes, is_rim) = trial, trial_shift, new
                damping = max(damping / 10, 1e-9)
                weights, trust, scatter = self._weights(residuals - slopes[:, 6:] @ shift, is_rim, weighted)
                cost = self._cost(residuals - slopes[:, 6:] @ shift, shift, weights, pose, tilt_prior_rad)
            else:
                damping *= 10
            if moved_px < _SMALL_STEP_PX or damping > 1e6:
                break
        weighted_slopes = slopes * weights[:, None]
        return _Fit(pose, shift, residuals, weights, trust, scatter, cost, slopes.T @ weighted_slopes)

    def _weights(
        self, residuals: Array, is_rim: NDArray[np.bool_], weighted: _Fit | None
    ) -> tuple[Array, Array, float]:
        if weighted is not None:
            return weighted.weights, weighted.trust, weighted.scatter_px
        variance = self.edges.sigma_px**2
        counted = is_rim if is_rim.sum() >= _FEWEST_POINTS else np.ones_like(is_rim)
        # Half of the points lie within 0.67 standard deviations.
        spread = (1.4826 * float(np.median(np.abs(residuals[counted])))) ** 2
        scatter2 = max(spread - float(np.median(variance[counted])), 0.0)
        total = variance + scatter2
        trust = np.where(is_rim, np.maximum(1 - residuals**2 / (total * _TUKEY_SIGMAS**2), 0.0) ** 2, 0.0)
        return trust / total, trust, float(np.sqrt(scatter2))

    def _cost(
        self, residuals: Array, shift: Array, weights: Array, pose: RigidTransform, tilt_prior_rad: float
    ) -> float:
        tilt = pose.rotation[:2, 2] / tilt_prior_rad
        shifts = shift @ self.shift_information @ shift
        return float((weights * residuals**2).sum() + shifts + tilt @ tilt) / 2

    def _equations(
        self,
        residuals: Array,
        slopes: Array,
        shift: Array,
        weights: Array,
        pose: RigidTransform,
        tilt_prior_rad: float,
    ) -> tuple[Array, Array]:
        """(12, 12) normal matrix and (12,) gradient of pose and shifts with their priors."""
        normal = slopes.T @ (slopes * weights[:, None])
        gradient = slopes.T @ (weights * (residuals - slopes[:, 6:] @ shift))
        normal[6:, 6:] += self.shift_information
        gradient[6:] -= self.shift_information @ shift
        normal[:6, :6] += _roll_information(pose)
        axis = pose.rotation[:, 2]
        slope = -skew(axis)[:2] / tilt_prior_rad
        normal[3:6, 3:6] += slope.T @ slope
        gradient[3:6] -= slope.T @ (axis[:2] / tilt_prior_rad)
        return normal, gradient


def rim_bound(rig: StereoRig, rim: RimOutline, pose: RigidTransform, sigma_px: float, count: int) -> Array:
    """Cramer-Rao bound of the pose from edge points evenly around the rim.

    Args:
        rig, rim: as built.
        pose: `left_from_drogue`.
        sigma_px: noise of a point across the edge. [px]
        count: of points in each eye.

    Returns:
        (6, 6) covariance in the tangent of `datasets_manifest.types.estimates`, with the priors of `EDGE_SHIFT_SD_PX`
        and an open roll. [m, rad]
    """
    angles = np.tile(2 * np.pi * np.arange(count) / count, len(EYES))
    eyes = np.repeat(np.arange(len(EYES)), count)
    eyes_m = np.stack([rig.eye_offset_m(eye) for eye in EYES])[eyes]
    places, normals = outline_points(rig, rim, pose, angles, eyes_m)
    problem = _Problem(rig, rim, RimEdges(eyes, places, normals, np.full(len(eyes), sigma_px), (1.0, 1.0), (1.0, 1.0)))
    _, slopes, _ = problem.linearised(pose)
    bound: Array = np.linalg.inv(_pose_information(slopes.T @ slopes / sigma_px**2, pose))
    return bound


def _pose_information(normal: Array, pose: RigidTransform) -> Array:
    """(6, 6) information of the pose from the points' (12, 12), with the priors of shifts and roll."""
    shifts = normal[6:, 6:] + _SHIFT_INFORMATION
    information: Array = normal[:6, :6] - normal[:6, 6:] @ np.linalg.solve(shifts, normal[6:, :6])
    return information + _roll_information(pose)


def outline_points(
    rig: StereoRig, rim: RimOutline, pose: RigidTransform, angles: Array, eyes_m: Array
) -> tuple[Array, Array]:
    """The outline of the rim's tube.

    Args:
        rig: of the ideal images.
        rim: its dimensions.
        pose: `left_from_drogue`.
        angles: (K,) around the axis. [rad]
        eyes_m: (K, 3) or (3,) centre of the eye that looks, in the left camera. [m]

    Returns:
        (K, 2) points [px], and (K, 2) unit vectors across the outline, outwards.

    Source: the outline of a tube lies a tube's radius from its middle line, along the normal of the plane through the
    eye and the line's tangent; exact but for the radius over the distance, squared.
    """
    camera = rig.camera
    place = _facing_points_m(rim, pose, angles, eyes_m)
    out, along = _directions(pose, angles)
    focal_px = np.array([camera.fx_px, camera.fy_px])

    def image_of(direction: Array) -> Array:
        shift: Array = focal_px * (direction[:, :2] - place[:, :2] / place[:, 2:] * direction[:, 2:]) / place[:, 2:]
        return shift

    tangent = image_of(along)
    normals = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= np.sign((normals * image_of(out)).sum(axis=1))[:, None]
    return camera.project(place), normals


def _directions(pose: RigidTransform, angles: Array) -> tuple[Array, Array]:
    """(K, 3) directions outwards and along the rim in the left camera."""
    c, s, zero = np.cos(angles), np.sin(angles), np.zeros(len(angles))
    return pose.rotate(np.stack([c, s, zero], -1)), pose.rotate(np.stack([-s, c, zero], -1))


def _facing_points_m(rim: RimOutline, pose: RigidTransform, angles: Array, eyes_m: Array) -> Array:
    """(K, 3) points of the tube on its outline, from the eye that looks. [m]"""
    out, along = _directions(pose, angles)
    tube_m = rim.tube_radius_m
    line = pose.translation_m + (rim.radius_m - tube_m) * out + tube_m * pose.rotation[:, 2] - eyes_m
    side = np.cross(along, line)
    side *= np.sign((side * out).sum(axis=1))[:, None] / np.linalg.norm(side, axis=1, keepdims=True)
    points: Array = line + tube_m * side
    return points


def without_roll(pose: RigidTransform) -> RigidTransform:
    """The pose with the same axis and roll zero."""
    return RigidTransform(rotations_from_axes(pose.rotation[None, :, 2])[0], pose.translation_m)


def _starts(rig: StereoRig, rim: RimOutline, edges: RimEdges) -> list[RigidTransform] | NoFixReason:
    """Both weak-perspective poses of the mean of both eyes' ellipses."""
    camera = rig.camera
    focal_px = np.array([camera.fx_px, camera.fy_px])
    centers, shapes = [], []
    for eye in range(len(EYES)):
        points = edges.points_px[edges.eyes == eye].astype(np.float32)
        (x, y), (width, height), turn_deg = cv2.fitEllipseDirect(points[:, None])
        if not (np.isfinite([x, y, width, height, turn_deg]).all() and min(width, height) > 0.3 * max(width, height)):
            return NoFixReason(f"the edge in the {EYES[eye]} image is no ellipse")
        turn = np.radians(turn_deg)
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        centers.append([x, y])
        shapes.append(axes @ np.diag([width / 2, height / 2]) @ axes.T)
    direction = camera.rays(np.mean(centers, axis=0))
    sizes, axes = np.linalg.eigh(np.mean(shapes, axis=0) / focal_px[:, None])
    translation = direction * rim.radius_m / sizes[1]
    translation[0] += rig.baseline_m / 2
    tilt = max(float(np.arccos(np.clip(sizes[0] / sizes[1], -1, 1))), _LEAST_START_RAD)
    toward = line_of_sight_rotations(direction[None])[0]
    across = axes[:, 0] * np.sin(tilt)
    return [
        without_roll(RigidTransform(_turn_to(toward @ np.array([*(sign * across), np.cos(tilt)])), translation))
        for sign in (1.0, -1.0)
    ]


def _turn_to(axis: Array) -> Array:
    rotation: Array = rotations_from_axes(axis[None] / np.linalg.norm(axis))[0]
    return rotation


def _misfit(problem: _Problem, fit: _Fit) -> NoFixReason | None:
    """Why the edges are not those of the drogue's rim; None when they are."""
    for eye, seen in zip(EYES, problem.edges.seen_fraction, strict=True):
        mine = problem.edges.eyes == EYES.index(eye)
        agreeing = seen * float(fit.trust[mine].mean())
        if agreeing < _LEAST_AGREEING:
            return NoFixReason(
                f"the edge in the {eye} image follows the rim on {100 * agreeing:.0f} % of its circumference, "
                f"{100 * _LEAST_AGREEING:.0f} % are needed"
            )
    if fit.scatter_px > _LARGEST_SCATTER_PX:
        return NoFixReason(f"the edge is not the rim's: it scatters about its outline by {fit.scatter_px:.2f} px")
    normal = fit.normal + np.pad(_roll_information(fit.pose), (0, len(EDGE_SHIFT_SD_PX)))
    normal[6:, 6:] += problem.shift_information
    scale = 1 / np.sqrt(np.diag(normal))
    sigma_px = float(np.sqrt(np.linalg.inv(normal * np.outer(scale, scale))[6, 6])) * scale[6]
    shift = float(fit.shift_px[0])
    if abs(shift) > _LARGEST_SHIFT_PX + _SHIFT_SIGMAS * sigma_px:
        return NoFixReason(
            f"the edge is not the rim's: by its disparity it lies {abs(shift):.1f} px "
            f"{'outside' if shift > 0 else 'inside'} of the rim"
        )
    return None


def _solution(observation: Observation, problem: _Problem, fits: list[_Fit], best: _Fit) -> Solution:
    """The better of two tilts, or their mean where the edges leave both."""
    # What the shape adds to the scatter is the same in both eyes, and counts once.
    own = float(np.median(problem.edges.sigma_px**2))
    common = 1 + best.scatter_px**2 / (best.scatter_px**2 + own)
    order = np.argsort([fit.cost for fit in fits], kind="stable")
    pairs = _pairs([fits[index] for index in order], common)
    weights = mode_weights(pairs, TILT_PRIOR_RAD)
    pose = RigidTransform(pairs.rotations[0, 0], pairs.translations_m[0, 0])
    covariance = np.linalg.inv(pairs.information[0, 0])
    if not _is_tilt_reliable(problem, pose, best, common):
        adjusted = [problem.adjust(fit.pose, best, TILT_PRIOR_RAD) for fit in fits]
        pairs = _pairs(adjusted, common, TILT_PRIOR_RAD)
        weights = mode_weights(pairs, np.inf)
        best_first = np.argsort(-weights, axis=1, kind="stable")
        pairs, weights = pairs.ordered(best_first), np.take_along_axis(weights, best_first, axis=1)
        rotations, translations, covariances = mixture_mean(pairs, weights)
        pose, covariance = without_roll(RigidTransform(rotations[0], translations[0])), covariances[0]
    modes = tuple(
        PoseMode(RigidTransform(rotation, translation), float(cost), float(weight))
        for rotation, translation, cost, weight in zip(
            pairs.rotations[0], pairs.translations_m[0], pairs.costs[0], weights[0], strict=True
        )
        if weight > 0
    )
    used = np.zeros_like(observation.seen)
    return Solution(pose, used, covariance, modes, note="the rim leaves the roll about its axis open")


def _pairs(fits: list[_Fit], common: float, tilt_prior_rad: float = np.inf) -> TiltPairs:
    information = []
    for fit in fits:
        slope = -skew(fit.pose.rotation[:, 2])[:2] / tilt_prior_rad
        information.append(fit.information(common) + np.pad(slope.T @ slope, ((3, 0), (3, 0))))
    return TiltPairs(
        np.stack([fit.pose.rotation for fit in fits])[None],
        np.stack([fit.pose.translation_m for fit in fits])[None],
        np.array([[fit.cost for fit in fits]]),
        np.stack(information)[None],
    )


def _is_tilt_reliable(problem: _Problem, pose: RigidTransform, fit: _Fit, common: float) -> bool:
    """Whether the tilt against the line of sight is clear of the deviation that it has for a frontal drogue."""
    middle = np.array([problem.rig.baseline_m / 2, 0.0, 0.0])
    frontal = line_of_sight_rotations((pose.translation_m - middle)[None])[0]
    facing = RigidTransform(frontal, pose.translation_m)
    _, slopes, _ = problem.linearised(facing)
    normal = slopes.T @ (slopes * fit.weights[:, None]) / common
    covariance = np.linalg.inv(_pose_information(normal, facing))[3:6, 3:6]
    across = frontal[:, :2].T @ covariance @ frontal[:, :2]
    tilt = float(np.linalg.norm(np.cross(pose.rotation[:, 2], frontal[:, 2])))
    return tilt > RELIABLE_SIGMAS * float(np.sqrt(np.trace(across) / 2))
