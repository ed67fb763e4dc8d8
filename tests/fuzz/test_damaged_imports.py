"""Folders of images, bags and calibrations as careless programs and people leave them, through `import`."""

from __future__ import annotations

import io
import itertools
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rosbags.rosbag2 import StoragePlugin

from datasets_manifest.calibration.calibration_files import calibration_files, opencv_stereo, opencv_stereo_matrices
from datasets_manifest.calibration.calibration_reader import read_calibration
from datasets_manifest.calibration.rig_report import rig_report
from datasets_manifest.importers.ros_bag import RosBag
from datasets_manifest.recipe.rigs import resolve_rig
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.writer import leftovers
from droguekit.batch.progress import PlainProgress
from droguekit.workflows.importing import ImportOptions, import_images
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, StereoRig
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from tests.support.damage_strategies import Edit, byte_edits, fuzz, quietly
from tests.support.ros_messages import stereo, write_bag1, write_bag2

WIDTH, HEIGHT = 16, 12
RIG = StereoRig(PinholeCamera(WIDTH, HEIGHT, 20.0, 20.0, 7.5, 5.5), 0.1)
# Templates of a pair's names; people mix them.
TEMPLATES = [
    ("left/{}", "right/{}"),
    ("Left/{}", "Right/{}"),
    ("left/left{}", "right/right{}"),
    ("left_{}", "right_{}"),
    ("{}_l", "{}_r"),
    ("mav0/cam0/data/{}", "mav0/cam1/data/{}"),
    ("image_02/data/{}", "image_03/data/{}"),
    ("{}", "{}"),
    ("left/._{}", "right/._{}"),
    ("a/left/{}", "b/right/{}"),
]
NUMBERS = ["1", "01", "0001", "2", "10", "1403636579763555584", "1403636579764555584", "1403636579.05", "1403636579.5"]
NUMBERS += ["20240131_120000", "x" * 200, "\u00e9 \u00fc", "a b", "'\"", "%s{}", "-1", "\u0663", ""]
SUFFIXES = [".png", ".png", ".png", ".PNG", ".jpg", ".webp", ".tif", ".bmp", ".txt", ""]
FORMATS = {".jpg": "JPEG", ".webp": "WEBP", ".tif": "TIFF", ".bmp": "BMP"}


@st.composite
def pictures(draw: st.DrawFn) -> bytes:
    """The bytes of a picture, mostly of the rig's size and upright."""
    width = draw(st.sampled_from([WIDTH] * 8 + [2 * WIDTH] * 4 + [HEIGHT, 1]))
    shape = (HEIGHT, width, 3) if draw(st.booleans()) else (HEIGHT, width)
    values = np.random.default_rng(draw(st.integers(0, 9))).integers(0, 256, shape)
    is_deep = len(shape) == 2 and draw(st.integers(0, 4)) == 0
    picture = Image.fromarray((values * 257).astype(np.uint16) if is_deep else values.astype(np.uint8))
    exif = Image.Exif()
    orientation = draw(st.sampled_from([None] * 12 + [1, 2, 3, 6, 8, 0, 9]))
    if orientation is not None:
        exif[274] = orientation
    stream = io.BytesIO()
    kind = "PNG" if is_deep else draw(st.sampled_from(["PNG", "PNG", *FORMATS.values()]))
    picture.save(stream, kind, exif=exif)
    data = stream.getvalue()
    return draw(byte_edits())(data) if draw(st.integers(0, 9)) == 0 else data


@st.composite
def folders(draw: st.DrawFn) -> dict[str, bytes]:
    """Files by path: pairs of one or two layouts, some without a partner, some of another kind."""
    templates = draw(st.lists(st.sampled_from(TEMPLATES), min_size=1, max_size=2))
    suffix, data = draw(st.sampled_from(SUFFIXES)), draw(pictures())
    files: dict[str, bytes] = {}
    for template, number in itertools.product(templates, draw(st.lists(st.sampled_from(NUMBERS), max_size=4))):
        for name in template:
            is_usual = draw(st.integers(0, 9)) > 0
            path = f"{name.format(number)}{suffix if is_usual else draw(st.sampled_from(SUFFIXES))}"
            if draw(st.integers(0, 19)) > 0 and path.rpartition("/")[2]:
                files[path] = data if is_usual else draw(pictures())
    if draw(st.integers(0, 9)) == 0:
        lines = ["2011-09-26 13:02:25.964389445", "1.0e-1", "", "nan", "2011-09-31 10:00:00.1"]
        files["image_02/timestamps.txt"] = "\n".join(draw(st.lists(st.sampled_from(lines)))).encode()
    return files


OPTIONS = st.builds(
    dict,
    rate_hz=st.sampled_from([None, None, 10.0]),
    stamp_tolerance_ms=st.sampled_from([0.0, 0.0, 0.0, 1.5, 1000.0]),
    folders=st.sampled_from([None] * 9 + ["left,right", "../left,right"]),
    bits=st.sampled_from([None, None, None, 10, 16]),
    black_level_dn=st.sampled_from([None, None, 3.0, 5000.0]),
)


@fuzz(50)
@given(files=folders(), options=OPTIONS)
def test_folders_of_images(files: dict[str, bytes], options: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        base = Path(place)
        (base / "in").mkdir()
        (base / "stereo.yaml").write_text(opencv_stereo(RIG))
        for name, data in files.items():
            path = base / "in" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        out = base / "out"
        settings = ImportOptions(calibration=(base / "stereo.yaml",), **options)
        quietly(lambda: import_images(base / "in", out, settings, PlainProgress(io.StringIO())))
        assert leftovers(base) == []
        assert {path.relative_to(base / "in").as_posix() for path in (base / "in").rglob("*") if path.is_file()} == {
            *files
        }
        if not out.exists():
            return
        dataset = BlindDataset(out)
        pairs = [dataset.pair(index) for index in dataset.frame_indices]
        assert pairs and all(pair.images.size_px == (WIDTH, HEIGHT) for pair in pairs)
        times_s = [pair.images.time_s for pair in pairs]
        assert times_s == sorted({*times_s})


@pytest.fixture(scope="module")
def bags(whole: Path) -> dict[str, Path]:
    """One recording in each form of a bag, and an export of ours, with the file to damage."""
    base = whole.with_name("bags")
    base.mkdir()
    for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        folder = write_bag2(base / f"{plugin.name}", stereo((3, 1, 2)), plugin)
        for file in folder.iterdir():
            if file.name != "metadata.yaml":
                shutil.copy(file, base / f"bare{file.suffix}")
    write_bag1(base / "ros1.bag", (3, 1, 2))
    write_export("rosbag", whole, base / "ours", ExportLog())
    (ours,) = base.glob("ours/*/*.mcap")
    found = {"bare mcap": base / "bare.mcap", "bare db3": base / "bare.db3", "ros 1": base / "ros1.bag", "ours": ours}
    return found | {"metadata": base / "MCAP" / "metadata.yaml"}


@fuzz(60)
@given(
    edits=st.lists(byte_edits(), min_size=1, max_size=2),
    form=st.sampled_from(["ours", "ours", "bare mcap", "bare db3", "ros 1", "metadata"]),
)
def test_damaged_bags(bags: dict[str, Path], edits: list[Edit], form: str) -> None:
    source = bags[form]
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        base = Path(place)
        is_folder = (source.parent / "metadata.yaml").is_file()
        path = Path(shutil.copytree(source.parent, base / "bag") if is_folder else shutil.copy(source, base))
        file = path / source.name if is_folder else path
        data = file.read_bytes()
        for edit in edits:
            data = edit(data)
        file.write_bytes(data)

        def use() -> None:
            bag = RosBag(path)
            times_s = [pair.time_s for pair in bag]
            assert len(times_s) == bag.count and times_s == sorted({*times_s})
            bag.rig()

        quietly(use)


def set_entry(name: str, place: tuple[int, int], value: float) -> Callable[[dict[str, Any]], None]:
    def change(matrices: dict[str, Any]) -> None:
        matrices[name][place] = value

    return change


def transpose(name: str) -> Callable[[dict[str, Any]], None]:
    def change(matrices: dict[str, Any]) -> None:
        matrices[name] = matrices[name].T

    return change


def swap(one: str, other: str) -> Callable[[dict[str, Any]], None]:
    def change(matrices: dict[str, Any]) -> None:
        matrices[one], matrices[other] = matrices[other], matrices[one]

    return change


def reshape(name: str, shape: tuple[int, ...]) -> Callable[[dict[str, Any]], None]:
    def change(matrices: dict[str, Any]) -> None:
        matrices[name] = np.resize(matrices[name], shape)

    return change


NAMES = ["M1", "M2", "D1", "D2", "R", "T", "R1", "R2", "P1", "P2"]
CHANGES = st.one_of(
    st.builds(transpose, st.sampled_from(["M1", "M2", "R", "T"])),
    st.builds(
        set_entry,
        st.sampled_from(["M1", "M2", "R", "R1", "P2"]),
        st.tuples(st.integers(0, 2), st.integers(0, 2)),
        st.sampled_from([0.0, -1.0, 2.0, 1e4, 1e300, float("nan"), float("inf")]),
    ),
    st.builds(swap, st.sampled_from(NAMES), st.sampled_from(NAMES)),
    st.builds(reshape, st.sampled_from(NAMES), st.sampled_from([(1, 1), (1, 4), (3, 1), (3, 3), (1, 14), (4, 4)])),
)


@fuzz(40)
@given(changes=st.lists(CHANGES, max_size=2), edits=st.lists(byte_edits(), max_size=1))
def test_calibrations(changes: list[Callable[[dict[str, Any]], None]], edits: list[Edit]) -> None:
    rig = resolve_rig("paper-real", 3)[0]
    matrices: dict[str, Any] = {name: np.array(matrix) for name, matrix in opencv_stereo_matrices(rig).items()}
    for change in changes:
        try:
            change(matrices)
        except IndexError:  # an earlier change left another shape
            continue
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / "stereo.yaml"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", rig.camera.width_px)
        storage.write("image_height", rig.camera.height_px)
        for name, matrix in matrices.items():
            storage.write(name, matrix)
        storage.release()
        for edit in edits:
            path.write_bytes(edit(path.read_bytes()))

        def use() -> None:
            read = read_calibration([path]).rig
            for camera in (read.camera, *(lens.camera for lens in map(read.lens, EYES) if lens is not None)):
                # A camera whose axis misses its own image is a transposed matrix, or worse.
                assert -0.5 <= camera.cx_px <= camera.width_px - 0.5 and -0.5 <= camera.cy_px <= camera.height_px - 0.5

        quietly(use)


@fuzz(40)
@given(edit=byte_edits(), other=byte_edits(), layout=st.sampled_from(["opencv_stereo", "kalibr_camchain", "ros"]))
def test_damaged_calibrations(edit: Edit, other: Edit, layout: str) -> None:
    files = calibration_files(resolve_rig("paper-real", 3)[0])
    texts = [text for name, text in files.items() if name.startswith(layout)]
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        paths = [Path(place) / f"calibration-{number}.yaml" for number in range(len(texts))]
        for path, text in zip(paths, texts, strict=True):
            path.write_text(text)
        paths[-1].write_bytes(edit(other(texts[-1].encode())))
        quietly(lambda: rig_report(read_calibration(paths)))
