"""The stereo rig of calibrated cameras, and the checks of the numbers that other programs give for them.

Images are not resampled. The rectified cameras become the rig's ideal eyes, and the calibrated cameras its lenses, so
that navigation measures in the original images and rectifies its measurements. A rectification that comes with the
calibration is kept: its rectified left camera is the frame of all poses. Without one it is that of OpenCV's
`stereoRectify`.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geometry.distortion import BrownConrady, Lens, OpenCvDistortion
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig

# A baseline outside this range is taken to be in another unit. [m]
_BASELINES_M = (1e-3, 10.0)
# In widths of the image, with a field of view of 157 degrees; shorter ones are in millimetres, or in image widths.
_SHORTEST_FOCAL_LENGTH = 0.1
# Skew below this is rounding. [px]
_SKEW_PX = 1e-9
# Numbers of coefficients of OpenCV's lens models; the first five are Brown-Conrady's.
_COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)
_BROWN_CONRADY_COUNT = 5
# Lower-case names of models, and of none, whose image without distortion is that of a pinhole; a fisheye's is not.
_PINHOLES = ("", "none", "pinhole", "radtan", "radial-tangential", "plumb_bob", "rational_polynomial")
# Six printed decimals move the entries of a rotation by 5e-7, five by 5e-6; a typing error moves them by more.
_ROTATION_TOLERANCE = 1e-4
_EXACT = 1e-12
# Of angles [rad] and relative lengths: what printed decimals move at most.
_FIT_TOLERANCE = 1e-4
# Rows of two rectified cameras that differ by less agree but for printed decimals. [px]
_SAME_PX = 1e-3


def camera_of_matrix(matrix: object, size_px: tuple[int, int], name: str) -> PinholeCamera:
    """A camera from its matrix, the principal point of which lies in the image.

    Args:
        matrix: (3, 3) or its nine entries row by row: fx 0 cx, 0 fy cy, 0 0 1. [px]
        size_px: (width, height) of its images.
        name: of the matrix, with its file; begins the errors.

    Raises:
        ValueError: not such a matrix.
    """
    m = finite_matrix(matrix, (3, 3), name)
    if _is_camera_matrix(m.T) and not _is_camera_matrix(m):
        raise ValueError(
            f"{name}: is transposed, as MATLAB's IntrinsicMatrix is; give fx 0 cx, 0 fy cy, 0 0 1 (MATLAB also counts "
            "pixels from 1: subtract 1 from its cx and cy)"
        )
    if not _is_camera_matrix(m):
        raise ValueError(f"{name}: must be fx 0 cx, 0 fy cy, 0 0 1 with positive fx and fy, got {m.tolist()}")
    if abs(m[0, 1]) > _SKEW_PX:
        raise ValueError(f"{name}: has a skew of {m[0, 1]:g} px, which is not supported; calibrate without skew")
    camera = PinholeCamera(*size_px, *(float(m[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))))
    if camera.fx_px < _SHORTEST_FOCAL_LENGTH * camera.width_px:
        raise ValueError(
            f"{name}: has focal lengths of ({camera.fx_px:g}, {camera.fy_px:g}) px, far too short for images of "
            f"{size_px[0]}x{size_px[1]} px; they must be in pixels of these images"
        )
    if not camera.contains([camera.cx_px, camera.cy_px]):
        raise ValueError(
            f"{name}: the principal point ({camera.cx_px:g}, {camera.cy_px:g}) lies outside the image of "
            f"{size_px[0]}x{size_px[1]} px; matrix and image size do not belong together"
        )
    return camera


def _is_camera_matrix(m: Array) -> bool:
    """Whether a matrix has the zeros and the one of a camera's, whatever its skew."""
    return bool(m[0, 0] > 0 < m[1, 1] and m[1, 0] == 0 and np.array_equal(m[2], [0, 0, 1]))


def nearest_rotation(matrix: object, name: str) -> Array:
    """The rotation nearest to a matrix with printed decimals.

    Args:
        matrix: (3, 3) or its nine entries row by row.
        name: of the matrix, with its file; begins the errors.

    Raises:
        ValueError: an entry is more than 1e-4 away from the rotation's.

    Source: Higham 1986, "Computing the polar decomposition".
    """
    m = finite_matrix(matrix, (3, 3), name)
    u, _, v = np.linalg.svd(m)
    rotation: Array = u @ v
    error = float(np.abs(rotation - m).max())
    if not error <= _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(f"{name}: is not a rotation matrix, got {m.tolist()}")
    return m if error < _EXACT else rotation


def is_ideal_pinhole(model: str, coefficients: Array) -> bool:
    """Whether a lens model with these coefficients has no distortion, whatever they mean in it."""
    return model.lower() in _PINHOLES and not coefficients.any()


def distortion_of_coefficients(coefficients: object, name: str) -> BrownConrady:
    """The lens model of OpenCV's coefficients k1, k2, p1, p2, k3 ...

    Args:
        coefficients: 4, 5, 8, 12 or 14 of them, or none for an ideal lens.
        name: of the coefficients, with their file; begins the errors.

    Raises:
        ValueError: another number of coefficients, or some that are not finite.
    """
    values = numbers(coefficients, name).reshape(-1)
    if len(values) not in (0, *_COEFFICIENT_COUNTS):
        raise ValueError(f"{name}: must have 4, 5, 8, 12 or 14 coefficients, got {len(values)}")
    if np.any(values[_BROWN_CONRADY_COUNT:]):
        return OpenCvDistortion(*values.tolist())
    return BrownConrady(*values[:_BROWN_CONRADY_COUNT].tolist())


def calibrated_lens(camera: PinholeCamera, distortion: BrownConrady, ideal_from_real: Array, name: str) -> Lens:
    """A camera with its lens; `name` is that of the coefficients, with their file, and begins the error.

    Raises:
        ValueError: the distortion folds the image, or the eye is turned too far.
    """
    try:
        # Numbers beyond all measure overflow before they are refused.
        with np.errstate(all="ignore"):
            Lens(camera, distortion)
    except ValueError as error:
        raise ValueError(
            f"{name}: {distortion.coefficients().tolist()} fold the image of {camera.width_px}x{camera.height_px} px: "
            "are they of cv2.fisheye, or of another image size? calibrate again"
        ) from error
    try:
        return Lens(camera, distortion, ideal_from_real)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def rig_of_cameras(left: Lens, right: Lens, right_from_left: RigidTransform, name: str) -> StereoRig:
    """The rig of two calibrated cameras; its left frame is the left camera that OpenCV's `stereoRectify` makes.

    Args:
        left, right: cameras and lenses; their rotations are not used.
        right_from_left: from the left camera's axes to the right one's. [m]
        name: of the translation, with its file; begins the errors.

    Raises:
        ValueError: an arrangement or a baseline that a rig cannot have.
    """
    baseline_m = float(np.linalg.norm(right_from_left.translation_m))
    _check_baseline(baseline_m, name)
    if _is_ideal(left, right, right_from_left):
        return StereoRig(left.camera, baseline_m)
    size_px = left.camera.width_px, left.camera.height_px
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        left.camera.matrix(),
        left.distortion.coefficients(),
        right.camera.matrix(),
        right.distortion.coefficients(),
        size_px,
        right_from_left.rotation,
        right_from_left.translation_m[:, None],  # OpenCV 5 takes no rows
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=-1,
    )
    if not P2[0, 3] < 0 or P2[1, 3] != 0:
        raise ValueError(
            f"{name}: the right camera must stand to the right of the left one, got "
            f"{right_from_left.translation_m.tolist()} m as its axes from the left one's (negative x); are the two "
            "swapped?"
        )
    lenses = Lens(left.camera, left.distortion, R1), Lens(right.camera, right.distortion, R2)
    return StereoRig(_rectified_camera(P1, size_px), baseline_m, lenses=lenses)


def rig_of_rectification(
    eyes: tuple[Lens, Lens],
    projections: tuple[object, object],
    names: tuple[str, str],
    unit_m: float = 1.0,
    right_from_left: RigidTransform | None = None,
) -> StereoRig:
    """The rig of two calibrated cameras with a given rectification, the left camera of which is the rig's left frame.

    Args:
        eyes: left and right camera with their lenses; `ideal_from_real` are the rectifying rotations R1 and R2.
        projections: (3, 4) P1 and P2 of the rectified images; the right one's last column begins with -fx B.
        names: of P1 and P2, with their files; begin the errors.
        unit_m: the unit of B. [m]
        right_from_left: R and T of the calibration, which the rectification must fit and which then give the baseline;
            None where they are not known. [m]

    Raises:
        ValueError: projections that do not rectify the pair, a baseline that a rig cannot have, or a rectification that
            does not fit R and T.

    Source: the definition of `sensor_msgs/CameraInfo`; OpenCV's documentation of `stereoRectify`.
    """
    left, right = eyes
    first, second = (finite_matrix(matrix, (3, 4), name) for matrix, name in zip(projections, names, strict=True))
    for matrix, name in zip((first, second), names, strict=True):
        if not _is_camera_matrix(matrix[:, :3]) or matrix[0, 1] != 0 or matrix[2, 3] != 0:
            raise ValueError(f"{name}: must be fx 0 cx tx, 0 fy cy ty, 0 0 1 0, got {matrix.tolist()}")
    if first[0, 3] < 0 and second[0, 3] == 0:
        raise ValueError(f"{names[0]}: is that of a right camera, and {names[1]} of a left one; swap the two")
    if first[1, 3] != 0 or second[1, 3] != 0:
        raise ValueError(f"{names[1]}: rectifies cameras that stand above each other, which are not supported")
    if first[0, 3] != 0 or not second[0, 3] < 0:
        raise ValueError(
            f"{names[1]}: entry (0, 3) must be -fx times the baseline, and that of {names[0]} 0, got "
            f"{second[0, 3]:g} and {first[0, 3]:g}; calibrate the two cameras as a pair"
        )
    # The principal points may differ along a row, where disparity is not 0 at infinity.
    differ = [entry for entry in ((0, 0), (1, 1), (1, 2)) if abs(first[entry] - second[entry]) > _SAME_PX]
    if differ:
        raise ValueError(
            f"{names[1]}: fx, fy and cy must be those of {names[0]}, got {second[:, :3].tolist()} and "
            f"{first[:, :3].tolist()}"
        )
    size_px = left.camera.width_px, left.camera.height_px
    if (right.camera.width_px, right.camera.height_px) != size_px:
        raise ValueError(f"{names[1]}: the images of both cameras must have the same size")
    baseline_m = float(-second[0, 3] / second[0, 0]) * unit_m
    if right_from_left is not None:
        _check_fit(left, right, right_from_left, baseline_m, names[1])
        baseline_m = float(np.linalg.norm(right_from_left.translation_m))
    _check_baseline(baseline_m, names[1])
    camera = _rectified_camera(first, size_px)
    if all(_is_rectified(lens, camera) for lens in (left, right)):
        return StereoRig(camera, baseline_m)
    return StereoRig(camera, baseline_m, lenses=(left, right))


def _rectified_camera(projection: Array, size_px: tuple[int, int]) -> PinholeCamera:
    """The ideal camera of a projection; its principal point may lie outside the image."""
    return PinholeCamera(*size_px, *(float(projection[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))))


def _check_fit(left: Lens, right: Lens, right_from_left: RigidTransform, baseline_m: float, name: str) -> None:
    """Check that R1, R2 and B rectify cameras that stand as R and T say.

    Raises:
        ValueError: they do not; tells by how much.
    """
    turn = right.ideal_from_real @ right_from_left.rotation @ left.ideal_from_real.T
    angle_rad = float(Rotation.from_matrix(turn).magnitude())
    shift_m = right.ideal_from_real @ right_from_left.translation_m
    want_m = float(np.linalg.norm(shift_m))
    if not want_m > 0:
        raise ValueError(f"{name}: does not fit a T of 0")
    slope_rad = float(np.linalg.norm(np.cross(shift_m, [-1.0, 0.0, 0.0]))) / want_m if shift_m[0] < 0 else np.pi
    if max(angle_rad, slope_rad, abs(baseline_m - want_m) / want_m) > _FIT_TOLERANCE:
        raise ValueError(
            f"{name}: the rectification R1, R2, P1, P2 does not fit R and T: its eyes are turned by "
            f"{np.degrees(angle_rad):.3g} degrees, its baseline by {np.degrees(slope_rad):.3g} degrees, and it is "
            f"{baseline_m:g} m long instead of {want_m:g} m; leave R1, R2, P1 and P2 out to have them computed"
        )


def _check_baseline(baseline_m: float, name: str) -> None:
    if not _BASELINES_M[0] <= baseline_m <= _BASELINES_M[1]:
        raise ValueError(f"{name}: must be in metres, and {baseline_m:g} m is not a plausible baseline; give its unit")


def _is_rectified(lens: Lens, camera: PinholeCamera) -> bool:
    """Whether an eye's images are rectified ones, which need no lens."""
    return (
        lens.camera == camera
        and not lens.distortion.coefficients().any()
        and np.array_equal(lens.ideal_from_real, np.eye(3))
    )


def _is_ideal(left: Lens, right: Lens, right_from_left: RigidTransform) -> bool:
    """Whether the images are rectified already, in which case rectification would only add rounding errors."""
    shift = right_from_left.translation_m
    return (
        not left.distortion.coefficients().any()
        and not right.distortion.coefficients().any()
        and left.camera == right.camera
        and np.array_equal(right_from_left.rotation, np.eye(3))
        and bool(shift[0] < 0)
        and not shift[1:].any()
    )


def finite_matrix(values: object, shape: tuple[int, int], name: str) -> Array:
    """A matrix of a shape from its rows or its entries row by row; `name` begins the errors.

    Raises:
        ValueError: of another size, or entries that are no finite numbers.
    """
    array = numbers(values, name)
    if array.size != shape[0] * shape[1]:
        raise ValueError(f"{name}: must have {shape[0]}x{shape[1]} entries, got {array.size}")
    return array.reshape(shape)


def numbers(values: object, name: str) -> Array:
    """Numbers of a file, which may stand there as text, as YAML 1.1 reads 1e-05; `name` begins the errors.

    Raises:
        ValueError: something else, or not finite.
    """
    if values is None:
        raise ValueError(f"{name}: must be numbers, got none that can be read")
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: must be numbers, got {str(values)[:100]}") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite, got {str(array.tolist())[:200]}")
    return array


def image_size(width: object, height: object) -> tuple[int, int] | None:
    """The (width, height) of images from two numbers of a file; None where they are none, or no whole ones."""
    sides = [
        side for side in (width, height) if isinstance(side, int | float) and side >= 1 and float(side).is_integer()
    ]
    return (int(sides[0]), int(sides[1])) if len(sides) == len((width, height)) else None
