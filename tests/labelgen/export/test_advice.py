"""Every piece of advice in an error of an export does what it says: each is gathered from the sources, and followed."""

from __future__ import annotations

import ast
import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export
from tests.support.recipe_builder import RIG_160_PX, recipe_text, stations

ROOT = Path(__file__).parents[3]
SOURCES = (
    *sorted((ROOT / "labelgen" / "export").rglob("*.py")),
    ROOT / "droguekit" / "cli" / "exchange_commands.py",
)
# Words with which a message goes on to say what to do.
ADVISES = re.compile(r"\b(add|choose|delete|give|install|let|name|run|take|there are|train|use)\b|is for|must lie")

# What each piece of advice is known by here, and the test below that follows it.
FOLLOWED = {
    "; use speed or rosbag": "test_formats_for_real_lenses_hold_them",
    "; use opencv or ros-camera-info": "test_calibrations_for_a_third_radial_coefficient_hold_it",
    "; there are ": "test_the_formats_that_are_listed_exist",
    "--images: is for ": "test_the_formats_with_images_on_request_copy_them",
    "--estimates: is for ": "test_the_formats_for_estimates_are_named",
    "pip install 'droguekit[": "test_the_extra_that_is_named_has_the_package",
    "; let `render` finish first": "test_a_dataset_whose_rendering_is_finished_is_exported",
    "; run droguekit validate": "test_validate_names_the_file_without_a_drogue",
    "--out: must lie outside": "test_a_folder_beside_the_dataset_is_taken",
    "; add --images": "test_images_are_added_to_their_bits",
    ": add --images for copies": "test_images_are_added_to_their_bits",
    ": train with fliplr=0": "test_exported_yolo.py",
}


def messages(path: Path) -> Iterator[str]:
    """Texts of ValueErrors and of log lines in a source, with {} for what is filled in."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call) or not node.args:
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in ("ValueError", "lost"):
            parts = node.args[0].values if isinstance(node.args[0], ast.JoinedStr) else [node.args[0]]
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts)


def advice_of(call: Callable[[], Any]) -> str:
    """The error of a call."""
    with pytest.raises(ValueError) as raised:
        call()
    return str(raised.value)


def formats_in(advice: str) -> list[str]:
    """The formats that an error names after its last semicolon."""
    words = re.findall(r"[a-z][a-z-]*", advice.rpartition(";")[2])
    return [word for word in words if word in FORMATS]


def test_every_piece_of_advice_is_known_and_followed() -> None:
    found = {message for path in SOURCES for message in messages(path)}
    advising = {message for message in found if ADVISES.search(message)}
    unknown = {message for message in advising if not any(known in message for known in FOLLOWED)}
    assert unknown == set()
    assert {known for known in FOLLOWED if not any(known in message for message in advising)} == set()
    tests = Path(__file__).read_text()
    assert all(f"def {name}(" in tests or name.endswith(".py") for name in FOLLOWED.values())


@pytest.mark.parametrize("name", ["kitti", "bop"])
def test_formats_for_real_lenses_hold_them(name: str, dataset_by_preset: Any, tmp_path: Path) -> None:
    dataset = dataset_by_preset("paper-real")
    advice = advice_of(lambda: write_export(name, dataset, tmp_path / "no", ExportLog()))
    assert formats_in(advice) == ["speed", "rosbag"]
    for other in formats_in(advice):
        assert write_export(other, dataset, tmp_path / other, ExportLog())


def test_calibrations_for_a_third_radial_coefficient_hold_it(dataset_by_preset: Any, tmp_path: Path) -> None:
    dataset = dataset_by_preset("paper-real", {"eyes": {"k3": {"low": 0.01, "high": 0.01}}})
    advice = advice_of(lambda: write_export("kalibr", dataset, tmp_path / "no", ExportLog()))
    assert formats_in(advice) == ["opencv", "ros-camera-info"]
    for other in formats_in(advice):
        assert all("0.01" in path.read_text() for path in write_export(other, dataset, tmp_path / other, ExportLog()))


def test_the_formats_that_are_listed_exist(mixed_dataset: Path, tmp_path: Path) -> None:
    assert formats_in(advice_of(lambda: write_export("voc", mixed_dataset, tmp_path, ExportLog()))) == list(FORMATS)


def test_the_formats_with_images_on_request_copy_them(mixed_dataset: Path, tmp_path: Path) -> None:
    advice = advice_of(lambda: write_export("kitti", mixed_dataset, tmp_path / "no", ExportLog(), image_bits=8))
    (named,) = re.findall("is for (.*);", advice)
    for name in named.split(", "):
        write_export(name, mixed_dataset, tmp_path / name, ExportLog(), image_bits=8)
        assert len(list((tmp_path / name).rglob("*.png"))) == 18


def test_the_formats_for_estimates_are_named(mixed_dataset: Path, tmp_path: Path) -> None:
    estimates = tmp_path / "estimates.jsonl"
    estimates.write_text('{"status": "no_fix", "frame_index": 0, "method": "none", "reason": "dark"}\n')
    advice = advice_of(lambda: write_export("coco", mixed_dataset, tmp_path / "no", ExportLog(), estimates=estimates))
    (named,) = re.findall("is for (.*);", advice)
    for name in named.split(", "):
        assert write_export(name, mixed_dataset, tmp_path / name, ExportLog(), estimates=estimates)


@pytest.mark.parametrize(("name", "package"), [("parquet", "pyarrow"), ("rosbag", "rosbags")])
def test_the_extra_that_is_named_has_the_package(
    name: str, package: str, mixed_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in [module for module in sys.modules if module.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, FORMATS[name].writer.split(":")[0], raising=False)
    advice = advice_of(lambda: write_export(name, mixed_dataset, tmp_path / "out", ExportLog()))
    (extra,) = re.findall(r"pip install 'droguekit\[(.*)\]'", advice)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert any(requirement.startswith(package) for requirement in extras[extra])


def test_a_dataset_whose_rendering_is_finished_is_exported(small_recipe: Any, tmp_path: Path) -> None:
    recipe, dataset = tmp_path / "recipe.toml", tmp_path / "dataset"
    rig = {**RIG_160_PX, "preset": "mono"}
    recipe.write_text(recipe_text(name="finished", rig=rig, frames={"count": 2, "scenes": 2}, distance=stations(2.0)))
    begun = tmp_path / "begun"
    begun.mkdir()
    write_manifest(
        begun, build_manifest(begun, small_recipe, "1", dict.fromkeys(range(small_recipe.frames.scenes), "train"))
    )
    assert "let `render` finish" in advice_of(lambda: write_export("coco", begun, tmp_path / "no", ExportLog()))
    assert run(["render", str(recipe), "--out", str(dataset), "--engine", "analytic", "--frames", "0:1"]) == DONE
    assert run(["render", str(recipe), "--out", str(dataset), "--engine", "analytic"]) == DONE
    assert write_export("coco", dataset, tmp_path / "out", ExportLog())


def test_validate_names_the_file_without_a_drogue(
    small_dataset: Path, full_pairs: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = small_dataset / "frames" / f"{full_pairs[0].frame.frame_index:06d}" / "left_parts.png"
    path.write_bytes(encode_png(np.zeros((120, 160), np.uint8)))
    advice = advice_of(lambda: write_export("coco", small_dataset, tmp_path / "out", ExportLog()))
    assert "run droguekit validate" in advice
    assert run(["validate", str(small_dataset)]) == FAULT
    assert f"{path.parent.name}/left_parts.png" in capsys.readouterr().out


def test_a_folder_beside_the_dataset_is_taken(mixed_dataset: Path, tmp_path: Path) -> None:
    advice_of(lambda: write_export("coco", mixed_dataset, mixed_dataset / "coco", ExportLog()))
    assert write_export("coco", mixed_dataset, tmp_path / "coco", ExportLog())


def test_images_are_added_to_their_bits(
    dataset_by_preset: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = str(dataset_by_preset("mono", {"output_bits": 12}))
    order = ["export", dataset, "--format", "coco", "--out", str(tmp_path / "out"), "--image-bits", "8"]
    assert run(order) == WRONG_INPUT
    assert "add --images" in capsys.readouterr().err
    assert run([*order, "--images"]) == DONE
    table = json.loads((tmp_path / "out" / "annotations" / "all.json").read_text())
    assert all((tmp_path / "out" / "images" / image["file_name"]).is_file() for image in table["images"])
