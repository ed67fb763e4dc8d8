"""The page on disk: what it holds, what a second run keeps, where datasets may lie, and what happens to bad ones."""

from __future__ import annotations

import fcntl
import io
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import fsspec
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage import layout
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import NoFix, PoseEstimate, write_estimates
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from droguekit.scoring.report.label_drawing import display_picture
from droguekit.visualization.browse.page import write_browse
from geometry.se3 import RigidTransform
from tests.support.recipe_builder import recipe_text
from tests.support.small_datasets import SINGLE_PAIRS, rendered

RECIPE = recipe_text(SINGLE_PAIRS)


def told() -> PlainProgress:
    return PlainProgress(io.StringIO())


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(RECIPE, tmp_path_factory.mktemp("tiny") / "dataset")


def catalogue(page: Path) -> dict[str, Any]:
    text = (page / "data" / "catalogue.js").read_text(encoding="utf-8")
    return json.loads(text.removeprefix("droguekit.catalogue = ").removesuffix(";\n"))


def labels(page: Path, frame: int) -> dict[str, Any]:
    (row,) = (row for row in catalogue(page)["rows"] if row["frame"] == frame)
    text = (page / "data" / f"{row['labels']}.js").read_text(encoding="utf-8")
    return json.loads(text.removeprefix(f'droguekit.receive("{row["labels"]}", ').removesuffix(");\n"))


def contents(page: Path) -> dict[str, bytes]:
    return {path.relative_to(page).as_posix(): path.read_bytes() for path in page.rglob("*") if path.is_file()}


def test_pictures_are_what_the_cameras_saw(tiny: Path, tmp_path: Path) -> None:
    summary = write_browse(tiny, tmp_path / "page", None, 2, told())
    assert (summary.shown, summary.kept, summary.skipped) == (4, 0, ())
    dataset = Dataset(tiny)
    for row in catalogue(tmp_path / "page")["rows"]:
        images = dataset.images(row["frame"])
        left = cv2.imread(str(tmp_path / "page" / "pictures" / f"{row['picture']}-left.jpg"))[..., ::-1]
        # JPEG of quality 85 leaves noisy sky within a few levels in the mean.
        assert np.abs(left.astype(int) - display_picture(images)).mean() < 4
        assert (tmp_path / "page" / "pictures" / f"{row['picture']}-right.jpg").is_file()


def test_labels_are_those_of_the_record(tiny: Path, tmp_path: Path) -> None:
    write_browse(tiny, tmp_path / "page", None, 0, told())
    dataset = Dataset(tiny)
    assert any(entry.empty for entry in dataset.manifest.frames)
    for index in dataset.frame_indices:
        record, found = dataset.record(index), labels(tmp_path / "page", index)
        pose = record.left_from_drogue
        assert (found["pose"] is None) == (pose is None)
        if pose is not None:
            np.testing.assert_allclose(np.reshape(found["pose"], (3, 4)), pose.as_matrix()[:3], atol=1e-9)
        assert [marker[2] for marker in found["left"]["markers"]] == pytest.approx(
            [marker.visible_fraction for marker in record.views.left.markers],
            abs=5e-4,  # they are rounded to a thousandth
        )


def test_a_second_run_keeps_pictures_and_makes_missing_ones(tiny: Path, tmp_path: Path) -> None:
    page = tmp_path / "page"
    write_browse(tiny, page, None, 0, told())
    before = contents(page)
    kept, lost, cut = sorted((page / "pictures").glob("*-left.jpg"))[:3]
    lost.unlink()
    # As after a power failure.
    cut.write_bytes(before[cut.relative_to(page).as_posix()][:-1])
    (page / "pictures" / ".000000-x.jpg-1.part").write_bytes(b"of a run that was killed")
    (page / "data" / "000099.js").write_text("of a pair that is not there any more")
    # Nobody would write this again: a picture that is kept stays as it is.
    kept.write_bytes(b"kept\xff\xd9")
    assert write_browse(tiny, page, None, 0, told()).kept == 2
    assert kept.read_bytes() == b"kept\xff\xd9"
    kept.write_bytes(before[kept.relative_to(page).as_posix()])
    assert contents(page) == before


def test_folders_of_others_in_the_page_stay(tiny: Path, tmp_path: Path) -> None:
    page = tmp_path / "page"
    write_browse(tiny, page, None, 0, told())
    for folder in ("pictures", "data"):
        (page / folder / "@eaDir").mkdir()
        (page / folder / "old.txt").touch()
    write_browse(tiny, page, None, 0, told())
    for folder in ("pictures", "data"):
        assert (page / folder / "@eaDir").is_dir() and not (page / folder / "old.txt").exists()


def test_pictures_of_other_pixels_are_replaced(tiny: Path, tmp_path: Path) -> None:
    other = rendered(recipe_text(SINGLE_PAIRS, seed=3), tmp_path / "other")
    write_browse(tiny, tmp_path / "page", None, 0, told())
    assert write_browse(other, tmp_path / "page", None, 0, told()).kept == 0
    write_browse(other, tmp_path / "fresh", None, 0, told())
    assert contents(tmp_path / "page") == contents(tmp_path / "fresh")


def test_a_run_that_is_stopped_leaves_the_page_as_it_was(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, page = rendered(recipe_text(SINGLE_PAIRS, seed=3), tmp_path / "other"), tmp_path / "page"
    write_browse(tiny, page, None, 0, told())
    before = contents(page)
    steps = iter(range(2))

    class Stopped(PlainProgress):
        def advance(self) -> None:
            if next(steps, None) is None:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_browse(other, page, None, 0, Stopped(io.StringIO()))
    after = contents(page)
    assert len(after) > len(before) and {name: after[name] for name in before} == before
    write_browse(tiny, page, None, 0, told())
    assert contents(page) == before


def test_a_false_fix_is_drawn_as_the_drogue_that_was_looked_for(tmp_path: Path) -> None:
    frames = {"count": 6, "scenes": 6, "empty_fraction": 0.5}
    text = recipe_text(SINGLE_PAIRS, frames=frames, target={"variants": [{"drogue": "red-8"}, {"drogue": "white-5"}]})
    dataset = Dataset(rendered(text, tmp_path / "dataset"))
    write_browse(tmp_path / "dataset", tmp_path / "page", None, 0, told())
    drogues, empty, named = catalogue(tmp_path / "page")["drogues"], 0, set()
    for index in dataset.frame_indices:
        frame = dataset.record(index).frame
        wanted = frame.drogue or frame.sought or dataset.manifest.recipe.drogue
        rim, *others = drogues[labels(tmp_path / "page", index)["drogue"]]
        assert (rim["kind"], rim["radius_m"]) == ("rim", wanted.rim_radius_m)
        assert sum(ring["kind"] == "marker" for ring in others) == wanted.marker_count
        empty += frame.drogue is None
        named.add(wanted.name)
    assert empty > 0 and named == {"red-8", "white-5"}


def test_what_methods_say_stands_in_their_order(tiny: Path, tmp_path: Path) -> None:
    dataset, found = Dataset(tiny), []
    for index in dataset.frame_indices[:-1]:
        found.append(NoFix(frame_index=index, method="blind", reason="nothing seen"))
        pose = dataset.record(index).left_from_drogue or RigidTransform(np.eye(3), np.array([0.0, 0.0, 3.0]))
        moved = RigidTransform(pose.rotation, pose.translation_m + np.array([0.003, 0.004, 0.0]))
        found.append(PoseEstimate(frame_index=index, method="__proto__", left_from_drogue=moved))
    write_estimates(tmp_path / "e.jsonl", found)
    write_browse(tiny, tmp_path / "page", tmp_path / "e.jsonl", 0, told())
    table = catalogue(tmp_path / "page")
    assert table["methods"] == ["blind", "__proto__"]
    for row in table["rows"]:
        error = "fix" if row["distance_m"] is None else pytest.approx(5.0, abs=1e-3)  # rounded to a micrometre
        silent = row["frame"] == dataset.frame_indices[-1]
        assert row["estimates"] == ([None, None] if silent else ["no fix", error])


def test_an_image_that_was_changed_is_left_out(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changed, page = tmp_path / "changed", tmp_path / "page"
    shutil.copytree(tiny, changed)
    image = layout.frame_folder(changed, 1) / "right.png"
    shutil.copy(layout.frame_folder(tiny, 2) / "right.png", image)
    assert run(["browse", str(changed), "--out", str(page), "--workers", "0"]) == FAULT
    assert (
        f"frame 1 is left out: {image}: was changed: its hash differs from the recorded one" in capsys.readouterr().err
    )
    shutil.copy(layout.frame_folder(tiny, 1) / "right.png", image)
    assert run(["browse", str(changed), "--out", str(page), "--workers", "0"]) == DONE
    write_browse(tiny, tmp_path / "plain", None, 0, told())
    pictures = {name: data for name, data in contents(page).items() if name.startswith("pictures/")}
    assert pictures and pictures.items() <= contents(tmp_path / "plain").items()


def test_a_run_that_was_killed_at_its_beginning_can_be_begun_again(tiny: Path, tmp_path: Path) -> None:
    page = tmp_path / "page"
    page.mkdir()
    (page / ".droguekit-browse-0123.part").write_text("Wri")
    assert run(["browse", str(tiny), "--out", str(page), "--workers", "0"]) == DONE


def test_two_runs_into_one_folder_are_refused(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page"
    write_browse(tiny, page, None, 0, told())
    with (page / ".droguekit-browse").open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert run(["browse", str(tiny), "--out", str(page), "--workers", "0"]) == WRONG_INPUT
    assert "another run is writing into it" in capsys.readouterr().err
    assert run(["browse", str(tiny), "--out", str(page), "--workers", "0"]) == DONE


@pytest.mark.parametrize("name", ["pictures", "data", "site", ".droguekit-browse"])
def test_what_leads_out_of_the_folder_is_refused(
    tiny: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    page, mine = tmp_path / "page", tmp_path / "mine"
    write_browse(tiny, page, None, 0, told())
    (page / name).rename(mine)
    (page / name).symlink_to(mine)
    if mine.is_dir():
        (mine / "thesis.txt").write_text("do not touch")
    before = contents(tmp_path)
    assert run(["browse", str(tiny), "--out", str(page), "--workers", "0"]) == WRONG_INPUT
    assert f"{page / name}: is a link" in capsys.readouterr().err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("place", ["tar", "memory"])
def test_pages_do_not_depend_on_where_the_pairs_lie(tiny: Path, tmp_path: Path, place: str) -> None:
    recipe = parse_recipe(RECIPE)
    source: Path | str = tmp_path / "tar"
    if place == "memory":
        source = f"memory://{tmp_path.name}-browse"
    render_dataset(
        RecipeSource(recipe, RECIPE),
        source,
        range(4),
        ExecutionOptions(0, pairs_per_tar=3 if place == "tar" else None),
        told(),
    )
    try:
        write_browse(source, tmp_path / "page", None, 0, told())
    finally:
        if isinstance(source, str):
            fsspec.filesystem("memory").rm(source.removeprefix("memory:/"), recursive=True)
    write_browse(tiny, tmp_path / "plain", None, 0, told())
    assert contents(tmp_path / "page") == contents(tmp_path / "plain")


@pytest.mark.parametrize("workers", [0, 1])
def test_a_truncated_image_is_named_and_the_others_are_shown(
    tiny: Path, tmp_path: Path, workers: int, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged, page = tmp_path / "<b>&amp;", tmp_path / "page"
    shutil.copytree(tiny, damaged)
    image = layout.frame_folder(damaged, 2) / "right.png"
    image.write_bytes(image.read_bytes()[:700])
    assert run(["browse", str(damaged), "--out", str(page), "--workers", str(workers)]) == FAULT
    heard = capsys.readouterr()
    assert f"frame 2 is left out: {image}" in heard.err
    assert heard.out == f"wrote {page / 'index.html'}: 3 pairs\n"
    assert [row["frame"] for row in catalogue(page)["rows"]] == [0, 1, 3]
    html = (page / "index.html").read_text(encoding="utf-8")
    assert "1 pair could not be read" in html and "<b>&amp;/" not in html and "&lt;b&gt;&amp;amp;/" in html
    # Mended, the same command adds it.
    shutil.copy(layout.frame_folder(tiny, 2) / "right.png", image)
    assert run(["browse", str(damaged), "--out", str(page), "--workers", str(workers)]) == DONE
    assert "4 pairs, 3 of them with the pictures of an earlier run" in capsys.readouterr().out


def test_pairs_without_truth_are_shown_too(tiny: Path, tmp_path: Path) -> None:
    assert run(["export", str(tiny), "--format", "blind", "--out", str(tmp_path / "blind")]) == DONE
    write_estimates(tmp_path / "e.jsonl", [NoFix(frame_index=1, method="own", reason="nothing seen")])
    arguments = [str(tmp_path / "blind"), "--out", str(tmp_path / "page"), "--workers", "0"]
    assert run(["browse", *arguments, "--estimates", str(tmp_path / "e.jsonl")]) == DONE
    found = catalogue(tmp_path / "page")
    assert found["is_blind"] and [row["distance_m"] for row in found["rows"]] == [None] * 4
    assert labels(tmp_path / "page", 1)["estimates"][0]["reason"] == "nothing seen"
    assert labels(tmp_path / "page", 1)["left"]["markers"] == []


def test_wrong_orders_are_refused_on_one_line(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("do not touch")
    write_estimates(tmp_path / "far.jsonl", [NoFix(frame_index=40, method="own", reason="x")])
    (tmp_path / "file").write_text("")
    page = str(tmp_path / "page")
    cases = [
        ([str(tiny), "--out", str(tmp_path / "mine")], "mine: exists already and is no page of this command"),
        ([str(tiny), "--out", str(tmp_path / "file")], "file: cannot be written: Not a directory"),
        ([str(tiny), "--out", "/proc/nowhere/page"], "/proc/nowhere/page: cannot be written"),
        ([str(tiny), "--out", page, "--estimates", str(tmp_path / "far.jsonl")], "frame 40 is not in the dataset"),
        ([str(tiny), "--out", page, "--estimates", str(tmp_path / "none.jsonl")], "none.jsonl: cannot be read"),
        ([str(tmp_path / "nothing"), "--out", page], "nothing: "),
        ([str(tiny), "--out", page, "--workers", "-1"], "--workers: must not be negative, got -1"),
        ([str(tiny), "--out", "s3://bucket/page"], "--out: must be a folder or file of this machine"),
    ]
    for arguments, fault in cases:
        assert run(["browse", *arguments]) == WRONG_INPUT, arguments
        heard = capsys.readouterr().err
        assert fault in heard and heard.count("\n") == 1, heard
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]
    assert not (tmp_path / "page").exists()


def test_a_page_that_cannot_be_written_is_no_fault_of_the_pairs(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page"
    write_browse(tiny, page, None, 0, told())
    picture = sorted((page / "pictures").glob("*-small.jpg"))[0]
    picture.unlink()
    picture.mkdir()
    assert run(["browse", str(tiny), "--out", str(page), "--workers", "1"]) == WRONG_INPUT
    heard = capsys.readouterr().err
    assert f"error: {picture}: cannot be written" in heard
