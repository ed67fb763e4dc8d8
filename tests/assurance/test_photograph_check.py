"""`droguekit real-check`: boxes on photographs of any kind, judged by drawn boxes, and looks beside known ones."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from datasets_manifest.importers.photographs import find_photographs
from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.reader import Dataset
from droguekit.assurance.photograph_check import PhotographCheck, check_lines, check_photographs
from droguekit.assurance.picture_looks import LOOKS, KnownLooks, measure_looks
from droguekit.batch.progress import progress_report
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from droguekit.scoring.report.label_drawing import display_picture
from nav.training.negative_photographs import read_photographs
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scenes
from tests.support.recipe_builder import between, recipe_text

Make = Callable[..., Path]
RECIPE = """
name = "near"
seed = 5
rig = { preset = "rgb-ideal", width_px = 320, height_px = 240, focal_px = 530.0 }
frames = { count = 3, scenes = 3, empty_fraction = 0.0 }
distance = { law = "stations", stations_m = [3.0, 4.0, 5.0] }
environment = { ground = "sea" }
render = { engine = "analytic" }
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("near")
    (folder / "near.toml").write_text(RECIPE)
    assert run(["render", str(folder / "near.toml"), "--out", str(folder / "data"), "--workers", "0"]) == DONE
    return folder / "data"


@pytest.fixture
def photographs(rendered: Path, tmp_path: Path) -> Path:
    """Three pictures of a drogue of several sizes and kinds of file, two without, and a file that is none."""
    folder = tmp_path / "photographs"
    (folder / "more").mkdir(parents=True)
    dataset = Dataset(rendered)
    for index, name in zip(dataset.frame_indices, ("a.png", "b.jpg", "more/c.tiff"), strict=True):
        picture = display_picture(dataset.images(index))[..., ::-1]
        if name.endswith("tiff"):
            picture = picture[:, 40:].astype(np.uint16) * 257
        cv2.imwrite(str(folder / name), picture)
    sky = np.tile(np.linspace(120, 200, 90)[:, None, None], (1, 150, 3)).astype(np.uint8)
    cv2.imwrite(str(folder / "sky.png"), sky)
    cv2.imwrite(str(folder / "grey.png"), sky[..., 0])
    cv2.imwrite(str(folder / ".hidden.png"), sky)
    (folder / "broken.jpg").write_bytes((folder / "b.jpg").read_bytes()[:300])
    return folder


def drawn(rendered: Path, shift_px: float = 0.0) -> dict[str, object]:
    """COCO boxes of the first two and the third picture, which is cut at the left, and a picture without."""
    dataset, annotations = Dataset(rendered), []
    names = ("a.png", "b.jpg", "c.tiff", "sky.png")
    for number, index in enumerate(dataset.frame_indices):
        box = dataset.record(index).views.left.box_visible_xywh_px
        assert box is not None
        x = box[0] + 0.5 + shift_px - (40.0 if number == 2 else 0.0)
        annotations.append({"id": number, "image_id": number, "category_id": 1, "bbox": [x, box[1] + 0.5, *box[2:]]})
    images = [{"id": number, "file_name": name} for number, name in enumerate(names)]
    return {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "drogue"}]}


def checked(folder: Path, boxes: Path | None = None, known: Path | None = None) -> PhotographCheck:
    return check_photographs(folder, "mobile-s", progress_report(), boxes=boxes, known=known)


def test_hits_misses_and_false_alarms(photographs: Path, rendered: Path, tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.json"
    boxes.write_text(json.dumps(drawn(rendered)))
    found = checked(photographs, boxes)
    assert [one.name for one in found.photographs] == ["a.png", "b.jpg", "grey.png", "more/c.tiff", "sky.png"]
    by_name = {one.name: one for one in found.photographs}
    assert all(by_name[name].hits == 1 and by_name[name].misses == 0 for name in ("a.png", "b.jpg", "more/c.tiff"))
    assert by_name["grey.png"].drawn is None and by_name["sky.png"].drawn == () and not by_name["sky.png"].found
    assert found.ap50 == pytest.approx(100.0)
    assert len(found.judged) == 4 and found.fault is not None and "broken.jpg" in found.fault
    assert "3 of 3 drogues found, 0 missed, 0 false alarms" in "\n".join(check_lines(found))

    boxes.write_text(json.dumps(drawn(rendered, shift_px=100.0)))
    wrong = checked(photographs, boxes)
    assert sum(one.hits for one in wrong.photographs) == 0 and wrong.ap50 == 0.0
    assert sum(one.misses for one in wrong.photographs) == 3
    assert sum(one.false_alarms for one in wrong.photographs) >= 3


def test_without_boxes_nothing_is_judged(photographs: Path) -> None:
    found = checked(photographs)
    assert found.ap50 is None and found.judged == ()
    assert sum(bool(one.found) for one in found.photographs) == 3
    assert all(box.is_true is None for one in found.photographs for box in one.found)


def test_the_command_writes_page_and_numbers(photographs: Path, rendered: Path, tmp_path: Path) -> None:
    page, numbers = tmp_path / "out" / "page.html", tmp_path / "out" / "numbers.json"
    words = ["real-check", str(photographs), "--known", str(rendered), "--html", str(page), "--json", str(numbers)]
    assert run(words) == FAULT
    text = page.read_text()
    assert all(name in text for name in ("a.png", "more/c.tiff", "broken.jpg")) and text.count("<img") == 5
    assert "http" not in text.replace("http://www.w3.org", "")
    assert PhotographCheck.model_validate_json(numbers.read_text()).known == "near"


def test_known_pictures_of_a_dataset_without_pairs_are_refused(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = parse_recipe(recipe_text(name="none", frames={"count": 4}, distance=between(3.0, 12.0)))
    write_manifest(tmp_path, build_manifest(tmp_path, recipe, RENDER_VERSION, split_of_scenes(recipe)))
    assert run(["real-check", str(photographs), "--known", str(tmp_path)]) == WRONG_INPUT
    assert f"{tmp_path}: holds no pairs yet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{none}"], "is no folder of pictures"),
        (["{empty}"], "has no pictures"),
        (["{photographs}", "--detector", "color-blob"], "must be a network"),
        (["{photographs}", "--boxes", "{boxes}"], "none of its images is among these"),
        (["{photographs}", "--box-category", "drogue"], "--box-category: needs --boxes"),
        (["{hostile}"], "has a name that is not UTF-8; rename it"),
    ],
)
def test_wrong_input(
    photographs: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    table = {"images": [{"id": 1, "file_name": "other.png"}], "annotations": []}
    (tmp_path / "other.json").write_text(json.dumps(table))
    hostile = tmp_path / "hostile"
    hostile.mkdir()
    Path(os.fsdecode(bytes(hostile) + b"/\xff.png")).write_bytes(b"")
    places = {"none": tmp_path / "none", "empty": tmp_path / "empty", "photographs": photographs, "hostile": hostile}
    given = [word.format(**places, boxes=tmp_path / "other.json") for word in words]
    assert run(["real-check", *given]) == WRONG_INPUT
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in error


def test_found_boxes_can_be_drawn_ones(photographs: Path, tmp_path: Path) -> None:
    """What `detect --mono` writes is what an annotation tool corrects and what `--boxes` reads."""
    (photographs / "broken.jpg").unlink()
    out = tmp_path / "found.json"
    assert run(["detect", str(photographs), "--mono", "--out", str(out)]) == DONE
    coco = COCO(str(out))
    assert [coco.imgs[number]["file_name"] for number in sorted(coco.imgs)][3] == "more/c.tiff"
    again = checked(photographs, out)
    assert len(again.judged) == 5 and again.ap50 == pytest.approx(100.0)
    assert sum(one.hits for one in again.photographs) == len(coco.anns) == 3
    few = tmp_path / "few.json"
    assert run(["detect", str(photographs), "--mono", "--least-score", "1", "--out", str(few)]) == DONE
    assert COCO(str(few)).anns == {}
    for words in (["--tracker", "flow"], ["--least-score", "2"]):
        assert run(["detect", str(photographs), "--mono", *words, "--out", str(few)]) == WRONG_INPUT


def test_pictures_are_found_in_folders_and_hidden_ones_are_not(photographs: Path) -> None:
    names = [path.relative_to(photographs).as_posix() for path in find_photographs(photographs)]
    assert names == ["a.png", "b.jpg", "broken.jpg", "grey.png", "more/c.tiff", "sky.png"]


def pictures(count: int, brightness: float, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    ramp = np.linspace(-30, 30, 96)[:, None, None]
    return [
        np.clip(brightness + rng.normal(0, 6) + ramp + rng.normal(0, 4, (96, 128, 3)), 0, 255).astype(np.uint8)
        for _ in range(count)
    ]


def test_strips_are_checked_and_shown(tmp_path: Path) -> None:
    """Pictures that are a thousand times as long as wide are drawn small, and looked at in part."""
    folder = tmp_path / "strips"
    folder.mkdir()
    for name, shape in (("wide.png", (4, 4000)), ("tall.png", (4000, 4)), ("dot.png", (1, 1))):
        assert cv2.imwrite(str(folder / name), np.full((*shape, 3), 90, np.uint8))
    page = tmp_path / "page.html"
    assert run(["real-check", str(folder), "--html", str(page)]) == DONE
    assert page.read_text().count("<img") == 3
    cuts = read_photographs(folder, (64, 96)).images
    assert cuts.shape == (3, 64, 96, 3) and (cuts == 90).all()


def test_pictures_that_all_look_alike_know_nothing_else() -> None:
    known = KnownLooks(np.zeros((4, 9)), ["day"] * 4, [0, 0, 1, 1])
    assert known.likeness(np.zeros(9)).is_covered
    assert not known.likeness(np.ones(9)).is_covered


def test_looks_measure_what_they_are_called() -> None:
    plain = pictures(1, 120, 0)[0]
    looks = dict(zip(LOOKS, measure_looks(plain), strict=True))
    assert looks["brightness"] == pytest.approx(120 / 255, abs=0.06)
    # A deviation of 4 levels in each of three channels, of which the mean is taken.
    assert 10 ** looks["noise"] == pytest.approx(4 / np.sqrt(3) / 255 + 1 / 255, rel=0.15)
    assert looks["slope"] == pytest.approx(-30 / 255, abs=0.02)
    warm = plain.astype(np.float64) * (1.2, 1.0, 0.8)
    changed = dict(zip(LOOKS, measure_looks(np.clip(warm, 0, 255).astype(np.uint8)), strict=True))
    assert changed["warmth"] > looks["warmth"] + 0.1 and changed["saturation"] > looks["saturation"]


def test_a_picture_of_a_known_family_is_near_it_and_a_strange_one_is_near_none() -> None:
    families = {"dark": 50.0, "bright": 190.0}
    looks, names, scenes = [], [], []
    for number, (family, brightness) in enumerate(families.items()):
        for index, picture in enumerate(pictures(20, brightness, number)):
            looks.append(measure_looks(picture))
            names.append(family)
            scenes.append(100 * number + index)
    known = KnownLooks(np.array(looks), names, scenes)
    for number, (family, brightness) in enumerate(families.items()):
        others = [known.likeness(measure_looks(one)) for one in pictures(40, brightness, 10 + number)]
        assert {one.family for one in others} == {family}
        # 95 % of the known ones have a neighbour so near; new ones are alike.
        assert sum(one.is_covered for one in others) >= 32
    noisy = np.random.default_rng(9).normal(190, 60, (96, 128, 3)).clip(0, 255).astype(np.uint8)
    strange = known.likeness(measure_looks(noisy))
    assert not strange.is_covered and strange.difference == "noisier than all of them"
    with pytest.raises(ValueError, match="two scenes"):
        KnownLooks(np.array(looks[:5]), names[:5], [1] * 5)
