"""What is exported, imported and navigated gives the poses of the dataset itself, on rigs of four kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_manifest.storage.blind import read_blind_index
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from droguekit.cli.main import DONE, run
from geometry.se3 import RigidTransform
from tests.support.recipe_builder import RIG_320_PX, recipe_text, stations

pytestmark = pytest.mark.slow

RIGS: Mapping[str, Mapping[str, Any]] = {
    "ideal": {},
    "real-lenses": {"preset": "paper-real"},
    "mono": {"preset": "mono", "output_bits": 12},
    "bayer": {"preset": "paper-colour"},
}
METHOD = "joint-hub"


@pytest.fixture(scope="module", params=list(RIGS))
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    recipe = folder / "recipe.toml"
    recipe.write_text(
        recipe_text(
            name=request.param,
            seed=20,
            rig={**RIG_320_PX, **RIGS[request.param]},
            frames={"count": 4, "scenes": 4},
            distance=stations(2.0, 3.0, 4.0, 6.0),
            split={"train": 1.0, "val": 0.0, "test": 0.0},
        )
    )
    assert run(["render", str(recipe), "--out", str(folder / "dataset"), "--engine", "analytic"]) == DONE
    return folder / "dataset"


@pytest.fixture(scope="module")
def direct(dataset: Path) -> dict[int, PoseEstimate]:
    found = fixes(dataset, dataset.parent / "direct.jsonl")
    assert len(found) >= 3
    return found


def fixes(dataset: Path, out: Path) -> dict[int, PoseEstimate]:
    """What `navigate` finds, by the place of the pair."""
    assert run(["navigate", str(dataset), "--method", METHOD, "--out", str(out)]) == DONE
    return {e.frame_index: e for e in read_estimates(out) if isinstance(e, PoseEstimate)}


def assert_same_poses(got: dict[int, PoseEstimate], want: dict[int, PoseEstimate]) -> None:
    """Each pose is within a tenth of its stated deviation."""
    assert got.keys() == want.keys()
    for index, estimate in want.items():
        assert estimate.covariance is not None
        one, other = got[index].left_from_drogue, estimate.left_from_drogue
        covariance = np.asarray(estimate.covariance)
        away = np.linalg.solve(np.linalg.cholesky(covariance), difference(one, other))
        assert np.linalg.norm(away) <= 0.1, f"pair {index}: {np.linalg.norm(away):.3f} standard deviations"


def difference(one: RigidTransform, other: RigidTransform) -> np.ndarray:
    """`one` minus `other` in the tangent space of estimates: translation [m], then rotation [rad]."""
    turn = Rotation.from_matrix(one.rotation @ other.rotation.T).as_rotvec()
    return np.concatenate([one.translation_m - other.translation_m, turn])


def test_a_bag_gives_the_same_poses(dataset: Path, direct: dict[int, PoseEstimate], tmp_path: Path) -> None:
    assert run(["export", str(dataset), "--format", "rosbag", "--out", str(tmp_path / "bags")]) == DONE
    bag, imported = tmp_path / "bags" / "single_pairs", tmp_path / "imported"
    assert run(["import", str(bag), "--out", str(imported)]) == DONE
    assert_same_poses(fixes(imported, tmp_path / "estimates.jsonl"), direct)


def folder_options(dataset: Path, calibration: Sequence[Path], shift: int) -> list[str]:
    """What `import` has to be told of images in a folder, whose values are moved up by `shift` bits."""
    source = Dataset(dataset)
    black_level_dn = source.record(source.frame_indices[0]).image_black_level_dn * 2**shift
    files = [word for path in calibration for word in ("--calibration", str(path))]
    return [*files, "--encoding", "linear", "--black-level", str(black_level_dn)]


def in_the_rig_of(dataset: Path, found: dict[int, PoseEstimate], imported: Path) -> dict[int, PoseEstimate]:
    """Poses in a dataset's rectified left camera instead of an imported one's, which may be turned otherwise."""
    ours, theirs = (
        np.eye(3) if lens is None else lens.ideal_from_real
        for lens in (read_blind_index(place).rig.lens("left") for place in (dataset, imported))
    )
    turn = RigidTransform(ours @ theirs.T, np.zeros(3))
    return {
        index: estimate.model_copy(update={"left_from_drogue": turn @ estimate.left_from_drogue})
        for index, estimate in found.items()
    }


@pytest.mark.parametrize("calibration", ["opencv", "ros-camera-info", "kalibr"])
def test_copied_images_and_a_calibration_give_the_same_poses(
    calibration: str,
    dataset: Path,
    direct: dict[int, PoseEstimate],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sensor = Dataset(dataset).manifest.recipe.sensor
    is_deep = sensor.output_bits > 8
    copies, files = tmp_path / "copies", tmp_path / "files"
    # 16 bits keep the sensor's own values.
    order = ["export", str(dataset), "--format", "coco", "--images", "--image-bits", "16"]
    assert run([*order, "--out", str(copies)]) == DONE
    # Interpolated colours have other centroids than the mosaic: the command must say so.
    assert ("without the raw mosaic" in capsys.readouterr().out) == (sensor.color == "bayer")
    assert run(["export", str(dataset), "--format", calibration, "--out", str(files)]) == DONE
    imported = tmp_path / "imported"
    options = folder_options(dataset, sorted(files.iterdir()), shift=4 if is_deep else 0)
    assert run(["import", str(copies / "images" / "train"), "--out", str(imported), *options]) == DONE
    if sensor.color != "bayer":
        found = fixes(imported, tmp_path / "estimates.jsonl")
        # Kalibr's file has no rectification, so import takes that of cv2.stereoRectify.
        same_frame = in_the_rig_of(dataset, found, imported) if calibration == "kalibr" else found
        assert_same_poses(same_frame, direct)


def test_images_of_kitti_give_the_same_poses(dataset: Path, direct: dict[int, PoseEstimate], tmp_path: Path) -> None:
    recipe = Dataset(dataset).manifest.recipe
    if recipe.rig.lenses is not None or recipe.sensor.output_bits > 8 or recipe.sensor.color == "bayer":
        pytest.skip("KITTI holds interpolated images of pinholes with 8 bits")
    assert run(["export", str(dataset), "--format", "kitti", "--out", str(tmp_path / "kitti")]) == DONE
    options = folder_options(dataset, [dataset / "calibration" / "opencv_stereo.yaml"], shift=0)
    imported = tmp_path / "imported"
    assert run(["import", str(tmp_path / "kitti" / "training"), "--out", str(imported), *options]) == DONE
    assert_same_poses(fixes(imported, tmp_path / "estimates.jsonl"), direct)
