import cv2
import numpy as np

from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices, write_calibration
from geometry.pinhole import PinholeCamera
from geometry.stereo import StereoRig, paper_rig

NAMES = ("M1", "D1", "M2", "D2", "R", "T", "R1", "R2", "P1", "P2", "Q")


def test_opencv_reads_what_was_written(tmp_path):
    rig = paper_rig()
    path = write_calibration(tmp_path, rig)[0]
    assert path.parent == tmp_path / "calibration"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (1280, 960)
    for name, matrix in opencv_stereo_matrices(rig).items():
        # The file holds 16 to 17 digits.
        np.testing.assert_allclose(storage.getNode(name).mat(), matrix, rtol=1e-15)
    assert set(opencv_stereo_matrices(rig)) == set(NAMES)
    assert storage.getNode("T").mat().ravel().tolist() == [-0.12, 0.0, 0.0]
    # The ROS and OpenCV form of the baseline: -f B.
    assert storage.getNode("P2").mat()[0, 3] == -256.0


def test_rectification_is_what_opencv_computes():
    rig = paper_rig()
    m = opencv_stereo_matrices(rig)
    r1, r2, p1, p2, q, _, _ = cv2.stereoRectify(
        m["M1"], m["D1"], m["M2"], m["D2"], (1280, 960), m["R"], m["T"], flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1
    )
    # Exact but for the rounding of a few products.
    np.testing.assert_allclose(r1, m["R1"], atol=1e-12)
    np.testing.assert_allclose(r2, m["R2"], atol=1e-12)
    # OpenCV may choose a principal point of its own: only focal length and baseline are fixed by the rig.
    for ours, theirs in ((m["P1"], p1), (m["P2"], p2)):
        np.testing.assert_allclose(theirs[[0, 1, 0], [0, 1, 3]], ours[[0, 1, 0], [0, 1, 3]], rtol=1e-12)
    np.testing.assert_allclose(q[[2, 3], [3, 2]], m["Q"][[2, 3], [3, 2]], rtol=1e-12)


def test_reprojection_matrix_inverts_the_projection():
    rig = StereoRig(PinholeCamera(640, 480, 800.0, 810.0, 320.5, 239.0), 0.25)
    points = np.random.default_rng(5).uniform([-1, -1, 2], [1, 1, 20], (20, 3))
    left, right = rig.project(points, "left"), rig.project(points, "right")
    seen = np.column_stack([left, left[:, 0] - right[:, 0], np.ones(20)]) @ opencv_stereo_matrices(rig)["Q"].T
    # Of disparities down to 10 px rounded to 1e-14 px.
    np.testing.assert_allclose(seen[:, :3] / seen[:, 3:], points, rtol=1e-11)


def test_the_same_rig_gives_the_same_bytes(tmp_path):
    one, other = (write_calibration(tmp_path / name, paper_rig())[0] for name in ("a", "b"))
    assert one.read_bytes() == other.read_bytes()
