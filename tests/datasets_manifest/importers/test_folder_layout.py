"""Layouts that cameras' programs and public datasets leave, by names alone: the files are empty."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest

from datasets_manifest.importers.image_folder import find_pairs


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def names_of(folder: Path, **options: object) -> list[tuple[str, str]]:
    found = find_pairs(folder, **options)  # type: ignore[arg-type]
    return [tuple(path.relative_to(folder).as_posix() for path in pair) for pair in found.pairs]  # type: ignore[misc]


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left/left00.png", "right/right00.png"),  # OpenCV's samples, in folders
        ("left/left_0001.png", "right/right_0001.png"),
        ("left/0001.png", "right/1.png"),
        ("left/1.png", "right/00001.png"),
        ("Left/0001.PNG", "Right/0001.png"),
        ("LEFT/7.jpg", "RIGHT/7.jpg"),
        ("image_left/000000_left.png", "image_right/000000_right.png"),  # TartanAir
        ("cam_left/a.tiff", "cam_right/a.tiff"),
        ("mav0/cam0/data/7.png", "mav0/cam1/data/7.png"),  # EuRoC
        ("image_02/data/0000000007.png", "image_03/data/0000000007.png"),  # KITTI raw
        ("infra1/000007.png", "infra2/000007.png"),  # RealSense
        ("im_l.webp", "im_r.webp"),
        ("left.png", "right.png"),
        ("left/7.png", "right/7.webp"),
    ],
)
def test_a_pair_is_found(left: str, right: str, tmp_path: Path) -> None:
    assert names_of(touch(tmp_path, left, right)) == [(left, right)]


def test_names_that_begin_with_a_dot_are_skipped(tmp_path: Path) -> None:
    touch(tmp_path, "left/1.png", "left/._1.png", "right/1.png", "right/._1.png", ".thumbs/left/1.png", "._left/1.png")
    found = find_pairs(tmp_path)
    assert [left.name for left, _ in found.pairs] == ["1.png"] and not found.left_out
    touch(tmp_path / "flat", "1.png", "._1.png")
    assert names_of(tmp_path / "flat") == [("1.png", "1.png")]


def test_padding_that_is_no_padding_stays(tmp_path: Path) -> None:
    """Where `1` and `01` are two images of a view, names must be equal."""
    touch(tmp_path, *(f"{eye}/{name}.png" for eye in ("left", "right") for name in ("1", "01")))
    assert names_of(tmp_path) == [("left/01.png", "right/01.png"), ("left/1.png", "right/1.png")]
    # Zeros in a decimal fraction count.
    touch(tmp_path / "stamps", "left/1403636579.05.png", "right/1403636579.5.png")
    with pytest.raises(ValueError, match="no names"):
        find_pairs(tmp_path / "stamps")


def test_names_that_do_not_match_are_shown(tmp_path: Path) -> None:
    touch(tmp_path, "left/apple.png", "right/pear.png")
    with pytest.raises(
        ValueError, match=r"no names of left and right images match, such as left/apple.png and right/p"
    ):
        find_pairs(tmp_path)
    touch(tmp_path / "flat", "left_1.png", "right_2.png")
    with pytest.raises(ValueError, match=r"match, such as flat/left_1.png and flat/right_2.png$"):
        find_pairs(tmp_path / "flat")


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        (("left/1.png", "right/readme.txt"), "has no images of the right view, and 1 of the other"),
        (("left_1.png", "left_2.png"), "has no images of the right view, and 2 of the other"),
        (("left/1.png",), "has left/ but no right/; choose the two by --folders LEFT,RIGHT"),
        (("cam1/1.png",), "has cam1/ but no cam0/"),
        (("left/1.txt", "right/1.txt"), "holds no images"),
        (("notes.txt",), "holds no images"),
        (
            ("image_00/data/1.png", "image_01/data/1.png", "image_02/data/1.png", "image_03/data/1.png"),
            "several pairs of folders; choose one by --folders from image_00/data,image_01/data and image_02/data,",
        ),
        (("a/left/1.png", "a/right/1.png", "b/left/1.png", "b/right/1.png"), "several recordings.*import them one by"),
        (("Left/1.png", "left/1.png", "right/1.png"), "several pairs of folders"),
    ],
)
def test_what_leaves_a_choice_is_refused(names: tuple[str, ...], fault: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=fault):
        find_pairs(touch(tmp_path, *names))


def test_folders_can_be_named(tmp_path: Path) -> None:
    """As the errors advise."""
    touch(tmp_path, *(f"image_0{number}/data/5.png" for number in range(4)), "22001/5.png", "22002/5.png")
    for given in (("image_02", "image_03"), ("image_00/data", "image_01/data"), ("22001", "22002")):
        ((left, right),) = names_of(tmp_path, names=given)
        assert (left.split("/")[0], right.split("/")[0]) == (given[0].split("/")[0], given[1].split("/")[0])
    with pytest.raises(ValueError, match=r"--folders: .*22003 is not a folder"):
        find_pairs(tmp_path, names=("22001", "22003"))


def test_named_folders_must_lie_in_the_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, *(f"{name}/{eye}/5.png" for name in ("flight", "other") for eye in ("a", "b")))
    monkeypatch.chdir(tmp_path)
    source, other = Path("flight"), tmp_path / "other"
    for names in ((str(tmp_path / "flight/a"), str(tmp_path / "flight/b")), ("a/../a", "../flight/b"), ("a", "./b")):
        assert names_of(source, names=names) == [("a/5.png", "b/5.png")]
    for name in (str(other / "b"), "../other/b", "a/../../other/b"):
        with pytest.raises(ValueError, match=rf"^--folders: must lie in flight, got {name}$"):
            find_pairs(source, names=("a", name))
    # A recording of links to folders is one.
    (source / "c").symlink_to(other / "a")
    assert names_of(source, names=("c", "b")) == [("c/5.png", "b/5.png")]


def test_files_beside_the_pairs_are_told(tmp_path: Path) -> None:
    touch(tmp_path, "left_1.png", "right_1.png", "overview.png")
    assert find_pairs(tmp_path).left_out == [f"{tmp_path}/overview.png: is neither of the left nor of the right view"]
    touch(tmp_path / "two", "left/1.png", "right/1.png", "overview.png")
    assert len(find_pairs(tmp_path / "two").left_out) == 1


STAMPS = [1403636579763555584, 1403636579813555456, 1403636579863555584]


@pytest.mark.parametrize(
    ("form", "resolution_ns"),
    [
        (lambda ns: f"{ns}", 1),  # EuRoC
        (lambda ns: f"{ns // 10**3}", 10**3),
        (lambda ns: f"{ns // 10**6}", 10**6),
        (lambda ns: f"{ns // 10**9}.{ns % 10**9 // 10**3:06d}", 10**3),  # TUM
        (lambda ns: f"frame-{ns}", 1),
    ],
)
def test_time_stamps_in_names_are_the_times(form: Callable[[int], str], resolution_ns: int, tmp_path: Path) -> None:
    touch(tmp_path, *(f"{eye}/{form(ns)}.png" for eye in ("left", "right") for ns in STAMPS))
    found = find_pairs(tmp_path)
    want = [1e-9 * (ns // resolution_ns * resolution_ns) for ns in STAMPS]
    # A double of this size has steps of 2.4e-7 s.
    assert found.times_s == pytest.approx(want, abs=5e-7, rel=0)
    assert found.times_from == "the time stamps in the names"
    assert find_pairs(tmp_path, rate_hz=10.0).times_s == [0.0, 0.1, 0.2]


@pytest.mark.parametrize(
    "name", ["0000000005", "20240131_120000", "5", "frame1403636579", "1403636579763555584-1403636579813555456"]
)
def test_counters_and_dates_are_no_time_stamps(name: str, tmp_path: Path) -> None:
    folder = touch(tmp_path, f"left/{name}.png", f"right/{name}.png")
    found = find_pairs(folder)
    assert found.times_s == [0.0] and found.times_from == "25 pairs a second; assumed, without --rate"
    assert find_pairs(folder, 25.0).times_from == "25 pairs a second (--rate)"


def test_time_stamps_of_a_pair_may_differ_within_the_tolerance(tmp_path: Path) -> None:
    touch(tmp_path, *(f"left/{ns}.png" for ns in STAMPS), *(f"right/{ns + 1_000_000}.png" for ns in STAMPS))
    with pytest.raises(ValueError, match=r"no names .*; --stamp-tolerance-ms lets time stamps differ"):
        find_pairs(tmp_path)
    assert len(find_pairs(tmp_path, tolerance_ns=1_000_000).pairs) == 3
    with pytest.raises(ValueError, match="no names"):
        find_pairs(tmp_path, tolerance_ns=999_999)
    with pytest.raises(ValueError, match=r"has two partners within 60 ms.*make the tolerance smaller"):
        find_pairs(tmp_path, tolerance_ns=60_000_000)
    with pytest.raises(ValueError, match="needs a time stamp in the name of every image"):
        find_pairs(touch(tmp_path / "plain", "left/1.png", "right/1.png"), tolerance_ns=1)
    with pytest.raises(ValueError, match="--stamp-tolerance-ms pairs two images, and each of these holds both views"):
        find_pairs(touch(tmp_path / "both", *(f"{ns}.png" for ns in STAMPS)), tolerance_ns=1)


def test_lists_of_times_are_read(tmp_path: Path) -> None:
    raw = touch(tmp_path / "raw", *(f"image_0{eye}/data/000000000{n}.png" for eye in (2, 3) for n in (0, 1, 2)))
    lines = ["2011-09-26 13:02:25.964389445", "2011-09-26 13:02:26.068000000", "2011-09-26 13:02:26.171"]
    (raw / "image_02" / "timestamps.txt").write_text("\n".join(lines) + "\n")
    found = find_pairs(raw)
    # date -u -d '2011-09-26 13:02:25' +%s
    assert found.times_s == pytest.approx([1317042145.964389445, 1317042146.068, 1317042146.171], abs=5e-7, rel=0)
    odometry = touch(tmp_path / "odometry", *(f"image_{eye}/00000{n}.png" for eye in (0, 1) for n in (0, 2)))
    (odometry / "times.txt").write_text("0.000000e+00\n1.038800e-01\n2.078000e-01\n")
    assert find_pairs(odometry).times_s == pytest.approx([0.0, 0.2078])
    for wrong in ("0.0\n", "0.0\n1.0\n1e400\n"):
        (odometry / "times.txt").write_text(wrong)
        with pytest.raises(ValueError, match=r"times\.txt: must list a time a line"):
            find_pairs(odometry)
    assert find_pairs(odometry, rate_hz=10.0).times_s == [0.0, 0.1]


@pytest.mark.parametrize("name", ["-1", "1_0", "+1", "first"])
def test_only_numbers_are_places_in_a_list_of_times(name: str, tmp_path: Path) -> None:
    folder = touch(tmp_path, f"left/{name}.png", f"right/{name}.png")
    (folder / "times.txt").write_text("".join(f"{line}.0\n" for line in range(20)))
    with pytest.raises(ValueError, match=r"times\.txt: must list a time a line .*: '.+' has no such number"):
        find_pairs(folder)
    assert find_pairs(folder, rate_hz=10.0).times_s == [0.0]


@pytest.mark.parametrize("rate_hz", [None, 10.0])
@pytest.mark.parametrize("layout", ["{eye}/{number:04d}.png", "{eye}_{number}.png"])
def test_an_image_without_a_partner_keeps_its_place_in_time(layout: str, rate_hz: float | None, tmp_path: Path) -> None:
    dropped = {"left": (3,), "right": range(5, 15)}
    kept = [(eye, number) for eye in dropped for number in range(1, 21) if number not in dropped[eye]]
    found = find_pairs(touch(tmp_path, *(layout.format(eye=eye, number=number) for eye, number in kept)), rate_hz)
    want = [number for number in range(1, 21) if number not in (3, *range(5, 15))]
    # Image 1 is the first.
    assert found.times_s == pytest.approx([(number - 1) / (rate_hz or 25.0) for number in want])
    assert len(found.left_out) == 11
    assert not any(name in line for line in found.left_out for name in ("0001", "_1.png", "0020", "_20.png"))


def test_places_count_pairs_of_near_stamps_once(tmp_path: Path) -> None:
    touch(tmp_path, *(f"left/{ns}.png" for ns in STAMPS), *(f"right/{ns + 1_000_000}.png" for ns in STAMPS[::2]))
    found = find_pairs(tmp_path, rate_hz=10.0, tolerance_ns=1_000_000)
    assert found.times_s == pytest.approx([0.0, 0.2])


def link(path: Path, target: str = "../../.git/annex/objects/1.png") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)


@pytest.mark.parametrize("has_partner", [True, False])
def test_links_whose_files_are_missing_are_told(has_partner: bool, tmp_path: Path) -> None:
    """As git-annex and DVC leave them."""
    touch(tmp_path, *(f"{eye}/{number}.png" for eye in ("left", "right") for number in (1, 3)))
    link(tmp_path / "left/2.png")
    if has_partner:
        touch(tmp_path, "right/2.png")
    else:
        link(tmp_path / "right/2.png")
    os.mkfifo(tmp_path / "right/4.png")
    found = find_pairs(tmp_path, rate_hz=10.0)
    assert [left.name for left, _ in found.pairs] == ["1.png", "3.png"]
    assert found.times_s == pytest.approx([0.0, 0.2])
    missing = "is a link to a file that is missing; fetch it"
    assert list(found.left_out) == [
        f"{tmp_path}/left/2.png: {missing}",
        f"{tmp_path}/right/2.png: {'has no partner' if has_partner else missing}",
        f"{tmp_path}/right/4.png: is no regular file",
    ]


@pytest.mark.parametrize("names", ["left/{}.png right/{}.png", "mav0/cam0/data/{}.png mav0/cam1/data/{}.png", "{}.png"])
def test_a_folder_of_nothing_but_such_links_is_refused(names: str, tmp_path: Path) -> None:
    for name in names.split():
        for number in (1, 2):
            link(tmp_path / name.format(number))
    with pytest.raises(ValueError, match=r"1\.png: is a link to a file that is missing; fetch it; no pair .* whole"):
        find_pairs(tmp_path)


def test_links_to_images_are_images(tmp_path: Path) -> None:
    touch(tmp_path, "store/a", "store/b")
    link(tmp_path / "flight/left/1.png", str(tmp_path / "store/a"))
    link(tmp_path / "flight/right/1.png", str(tmp_path / "store/b"))
    assert names_of(tmp_path / "flight") == [("left/1.png", "right/1.png")]


@pytest.mark.parametrize("layout", ["{eye}/{name}.png", "{eye}_{name}.png"])
@pytest.mark.parametrize("tail", ["", "é"])
def test_names_in_two_forms_of_unicode_are_a_pair(layout: str, tail: str, tmp_path: Path) -> None:
    """A folder of macOS beside one of Linux; the letter may be the first or the last too."""
    forms = {"left": "NFD", "right": "NFC"}
    names = [
        layout.format(eye=eye, name=unicodedata.normalize(form, f"é vol{tail} 7"))  # type: ignore[arg-type]
        for eye, form in forms.items()
    ]
    assert names_of(touch(tmp_path, *names)) == [tuple(names)]
