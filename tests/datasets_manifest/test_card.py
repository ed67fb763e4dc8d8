"""The dataset's card and its Croissant description, against the dataset and against other people's readers."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.release.card import card_text, citation, describe_croissant, write_card, write_croissant
from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER, RECORD_FILE, frame_folder
from datasets_manifest.storage.manifest import build_manifest, read_manifest, write_manifest

# https://huggingface.co/docs/hub/datasets-cards and the lists that it names.
HUB_SIZES = {"n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "n>1M"}


@pytest.fixture
def described(tiny: Path) -> Path:
    """The folder of a small dataset with one annotation file, card and description."""
    (tiny / ANNOTATIONS_FOLDER).mkdir(exist_ok=True)
    (tiny / ANNOTATIONS_FOLDER / "all.json").write_text("{}", encoding="utf-8")
    manifest = read_manifest(tiny)
    write_card(tiny, manifest)
    write_croissant(tiny, manifest)
    return tiny


def front_matter(card: str) -> dict[str, Any]:
    _, head, _ = card.split("---\n", 2)
    table = yaml.safe_load(head)
    assert isinstance(table, dict)
    return table


def test_the_cards_metadata_are_those_of_hugging_face(described: Path) -> None:
    table = front_matter((described / "README.md").read_text(encoding="utf-8"))
    assert table["license"] == "cc-by-4.0"
    assert set(table["size_categories"]) <= HUB_SIZES
    assert table["task_categories"] == ["object-detection", "keypoint-detection"]
    assert table["viewer"] is False


@pytest.mark.parametrize(("pairs", "size"), [(499, "n<1K"), (500, "1K<n<10K"), (7149, "10K<n<100K"), (600_000, "n>1M")])
def test_the_size_counts_images(described: Path, pairs: int, size: str) -> None:
    manifest = read_manifest(described)
    larger = manifest.model_copy(update={"counts": manifest.counts.model_copy(update={"pairs": pairs})})
    assert front_matter(card_text(larger))["size_categories"] == [size]


def test_the_card_is_a_function_of_the_manifest(described: Path, tmp_path: Path) -> None:
    manifest = read_manifest(described)
    assert write_card(tmp_path, manifest).read_bytes() == (described / "README.md").read_bytes()
    assert str(described) not in card_text(manifest)


def test_the_card_says_what_how_licence_limits_and_how_to_cite(described: Path) -> None:
    manifest, text = read_manifest(described), (described / "README.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    wanted = ["What is in it", "How it was made", "What it is for", "Limits", "Licence", "How to cite"]
    assert headings == wanted
    assert f"* {manifest.counts.pairs} stereo pairs" in text
    assert manifest.data_licence in text
    assert citation(manifest) in text and manifest.dataset_sha256 in citation(manifest)


def test_missing_pairs_and_the_rangefinder_are_told(described: Path) -> None:
    manifest = read_manifest(described)
    frames = manifest.recipe.frames.model_copy(update={"count": manifest.counts.pairs + 3})
    bench = load_recipe("semi-physical-5").recipe.rangefinder
    recipe = manifest.recipe.model_copy(update={"frames": frames, "rangefinder": bench})
    text = card_text(manifest.model_copy(update={"recipe": recipe}))
    assert f"3 of the recipe's {frames.count} pairs are not in it." in text
    assert "`frame.rangefinder_reading_m`" in text
    assert "rangefinder" not in card_text(manifest)


def test_croissant_names_the_files_by_their_hashes(described: Path) -> None:
    table = json.loads((described / "croissant.json").read_text(encoding="utf-8"))
    files = [entry for entry in table["distribution"] if entry["@type"] == "cr:FileObject"]
    assert [entry["contentUrl"] for entry in files] == ["manifest.json", f"{ANNOTATIONS_FOLDER}/all.json"]
    for entry in files:
        data = (described / entry["contentUrl"]).read_bytes()
        assert entry["sha256"] == hashlib.sha256(data).hexdigest()
        assert entry["contentSize"] == f"{len(data)} B"


def test_croissants_file_sets_hold_one_file_of_each_pair(described: Path) -> None:
    table = json.loads((described / "croissant.json").read_text(encoding="utf-8"))
    sets = [entry for entry in table["distribution"] if entry["@type"] == "cr:FileSet"]
    assert len(sets) == 5
    for entry in sets:
        assert len(list(described.glob(entry["includes"]))) == read_manifest(described).counts.pairs


def test_croissants_paths_lead_to_values(described: Path) -> None:
    manifest = json.loads((described / "manifest.json").read_text(encoding="utf-8"))
    index = manifest["frames"][0]["frame_index"]
    record = json.loads((frame_folder(described, index) / RECORD_FILE).read_text(encoding="utf-8"))
    table = describe_croissant(described, read_manifest(described))
    paths = 0
    for field in (field for records in table["recordSet"] for field in records["field"]):
        path = field["source"]["extract"].get("jsonPath")
        if path is None:
            continue
        value: Any = manifest if "fileObject" in field["source"] else record
        for key in path.replace("[*]", ".0").removeprefix("$.").split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        paths += 1
    assert paths == 12


def test_croissant_is_valid_for_its_makers_reader(described: Path) -> None:
    command = shutil.which("mlcroissant")
    if command is None:
        pytest.skip("mlcroissant is not installed: `pip install mlcroissant` in an environment of its own, on the PATH")
    result = subprocess.run(
        [command, "validate", "--jsonld", str(described / "croissant.json")], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert "error" not in result.stderr.lower()


def test_a_dataset_without_pairs_is_described_too(tmp_path: Path) -> None:
    recipe = load_recipe("smoke").recipe
    write_manifest(tmp_path, build_manifest(tmp_path, recipe, "0", dict.fromkeys(range(recipe.frames.scenes), "train")))
    manifest = read_manifest(tmp_path)
    assert "* 0 stereo pairs" in card_text(manifest)
    assert len(describe_croissant(tmp_path, manifest)["distribution"]) == 6


def test_hostile_texts_change_nothing_but_themselves(described: Path) -> None:
    """Texts of recipe and manifest are one line each, and neither HTML nor Markdown of their own."""
    manifest = read_manifest(described)
    evil = "x\n---\n\n## Licence\nMIT <script>alert(1)</script> ```\n[here](javascript:alert) \x1b[2J\u202e}\n"
    sensor = manifest.recipe.sensor.model_copy(update={"name": evil})
    recipe = manifest.recipe.model_copy(update={"description": evil, "sensor": sensor})
    changes = {"software": {"droguekit": evil}, "engines": {evil: 3}, "data_licence": evil, "recipe": recipe}
    hostile = manifest.model_copy(update=changes)
    text, before = card_text(hostile), card_text(manifest)
    assert re.findall(r"^(?:#|---|```).*$", text, re.MULTILINE) == re.findall(
        r"^(?:#|---|```).*$", before, re.MULTILINE
    )
    assert front_matter(text)["license"] == evil.lower()
    _, text = text.split("\n---\n", 1)
    assert (
        "<script" not in text
        and "\x1b" not in text
        and "\u202e" not in text
        and not re.search(r"(?<!\\)\[[^\]]*\]\(", text)
    )
    assert len(citation(hostile).splitlines()) == len(citation(manifest).splitlines())
    assert citation(hostile).count("{") == citation(hostile).count("}") == citation(manifest).count("}")
    table = json.loads(json.dumps(describe_croissant(described, hostile)))
    assert table["description"] == evil and table["@type"] == "sc:Dataset"
