"""Published manifests: what a regeneration proves, and that the shipped ones are those of the shipped recipes."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RecipeSource, load_recipe, parse_recipe
from datasets_manifest.release.publication import (
    Publication,
    PublishedComparison,
    build_publication,
    compare_with_published,
    publication_names,
    publication_text,
    read_publication,
)
from datasets_manifest.storage.layout import RECORD_FILE, frame_folder
from datasets_manifest.storage.manifest import build_manifest, read_manifest, with_build, write_manifest
from datasets_manifest.storage.writer import encode_record
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import RunSummary, render_dataset
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from geometry.stereo import EYES
from labelgen.part_pixels import drogue_box
from render.version import RENDER_VERSION
from scenes.sampler import sample_left_from_drogue, split_of_scenes
from studies.publish.__main__ import PUBLISHED, publish
from tests.support.batch_datasets import ANALYTIC_RECIPE

OTHER_FEATURES = ("SSE", "SSE2")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight pairs without a renderer; to be read only."""
    out = tmp_path_factory.mktemp("published") / "dataset"
    _render(ANALYTIC_RECIPE, out)
    return out


def _render(text: str, out: Path, seed: int | None = None) -> RunSummary:
    recipe = parse_recipe(text, seed=seed)
    return render_dataset(RecipeSource(recipe, text), out, range(recipe.frames.count), 0, PlainProgress(io.StringIO()))


def relit(dataset: Path, out: Path, features: tuple[str, ...] | None = None) -> Path:
    """A copy in which what follows from the pixels of pair 3 has other last digits, as another processor makes it."""
    shutil.copytree(dataset, out)
    path = frame_folder(out, 3) / RECORD_FILE
    record = PairRecord.model_validate_json(path.read_bytes())
    brighter = record.conditions.background_luminance_cd_m2 * (1 + 1e-9)
    conditions = record.conditions.model_copy(update={"background_luminance_cd_m2": brighter})
    path.write_bytes(encode_record(record.model_copy(update={"conditions": conditions})))
    old = read_manifest(dataset)
    manifest = build_manifest(out, old.recipe, old.render_version, split_of_scenes(old.recipe))
    write_manifest(out, manifest if features is None else with_build(manifest, manifest.software, features))
    return out


def verdicts(comparison: PublishedComparison) -> tuple[str, int, int]:
    return comparison.verdict, comparison.compared, comparison.identical


def test_what_is_published_reads_back_the_same(dataset: Path) -> None:
    publication = build_publication(dataset)
    text = publication_text(publication)
    assert publication_text(Publication.model_validate_json(text)) == text
    assert len(publication.labels) == 8


def test_a_regeneration_is_identical(dataset: Path, tmp_path: Path) -> None:
    _render(ANALYTIC_RECIPE, tmp_path / "again")
    assert verdicts(compare_with_published(tmp_path / "again", build_publication(dataset))) == ("identical", 8, 8)


def test_another_build_with_the_same_labels_is_equivalent(dataset: Path, tmp_path: Path) -> None:
    comparison = compare_with_published(relit(dataset, tmp_path / "a", OTHER_FEATURES), build_publication(dataset))
    assert verdicts(comparison) == ("equivalent", 8, 7)
    assert comparison.build_differences == ("another set of processor features",)


def test_the_same_build_with_other_pixels_is_different(dataset: Path, tmp_path: Path) -> None:
    comparison = compare_with_published(relit(dataset, tmp_path / "a"), build_publication(dataset))
    assert verdicts(comparison) == ("different", 8, 7)
    assert comparison.label_faults == ()


def test_another_label_is_found_on_any_machine(dataset: Path, tmp_path: Path) -> None:
    published = build_publication(dataset)
    labels = list(published.labels)
    view = labels[3].left
    assert view is not None
    u, *rest = view.box_full_xywh_px
    labels[3] = labels[3].model_copy(
        update={"left": view.model_copy(update={"box_full_xywh_px": (u * (1 + 1e-8), *rest)})}
    )
    changed = published.model_copy(update={"labels": tuple(labels)})
    comparison = compare_with_published(relit(dataset, tmp_path / "a", OTHER_FEATURES), changed)
    assert comparison.verdict == "different"
    assert comparison.label_faults == ("frame 3: left.box_full_xywh_px[0]: differs from what was published",)


def test_another_render_version_is_told_as_such(dataset: Path) -> None:
    published = build_publication(dataset)
    older = published.model_copy(update={"manifest": published.manifest.model_copy(update={"render_version": "0"})})
    comparison = compare_with_published(dataset, older)
    assert verdicts(comparison) == ("different", 8, 8)
    assert comparison.label_faults == (
        f"published by render version 0, this is {RENDER_VERSION}; `make publish` is due where that is the newer one",
    )


def test_last_bits_of_a_preset_make_no_other_recipe(dataset: Path) -> None:
    published = build_publication(dataset)
    recipe = published.manifest.recipe
    places = tuple((np.nextafter(x, 1.0), y) for x, y in recipe.drogue.marker_positions_m)
    turned = recipe.model_copy(update={"drogue": recipe.drogue.model_copy(update={"marker_positions_m": places})})
    manifest = published.manifest.model_copy(update={"recipe": turned})
    there = published.model_copy(update={"manifest": manifest})
    assert compare_with_published(dataset, there).verdict == "identical"


def test_another_seed_is_another_dataset(dataset: Path, tmp_path: Path) -> None:
    _render(ANALYTIC_RECIPE, tmp_path / "other", seed=6)
    comparison = compare_with_published(tmp_path / "other", build_publication(dataset))
    assert verdicts(comparison) == ("different", 0, 0)
    assert comparison.label_faults[0].endswith("is not the published quick: seed")


def test_nothing_published_is_one_clear_line(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["validate", str(dataset), "--published"]) == WRONG_INPUT
    assert "published: there is no manifest of 'quick'; there are " in capsys.readouterr().err


def test_the_command_says_what_it_proved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = load_recipe("pose-tier-a")
    out = tmp_path / "dataset"
    render_dataset(source, out, range(2), 0, PlainProgress(io.StringIO()))
    code = run(["validate", str(out), "--published"])
    shown = capsys.readouterr().out
    here, there = read_manifest(out), read_publication("pose-tier-a").manifest
    is_same = (here.software, set(here.cpu_features)) == (there.software, set(there.cpu_features))
    if is_same and here.engines.keys() == there.engines.keys():
        assert code == DONE
        assert "published: all 2 pairs compared are the same bit for bit, records and images" in shown
    else:
        assert code == DONE
        assert "not the build that was published: " in shown


def test_a_dataset_with_another_pixel_fails(tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changed = shutil.copytree(dataset, tmp_path / "changed")
    record = frame_folder(changed, 0) / RECORD_FILE
    record.write_text(record.read_text().replace('"frame_index":0', '"frame_index":0 '))
    assert run(["validate", str(changed), "--published"]) == FAULT
    assert "published" not in capsys.readouterr().out


def test_publishing_never_keeps_old_frames(tmp_path: Path) -> None:
    (tmp_path / "smoke").mkdir()
    with pytest.raises(ValueError, match="exists already; published datasets are rendered from scratch"):
        publish("smoke", None, tmp_path, tmp_path, PlainProgress(io.StringIO()))


def test_published_manifests_are_of_recipes_that_are_published() -> None:
    assert set(publication_names()) == set(PUBLISHED)


@pytest.mark.parametrize("name", publication_names())
def test_what_is_published_is_of_this_render_version(name: str) -> None:
    assert read_publication(name).manifest.render_version == RENDER_VERSION, "`make publish` is due"


@pytest.mark.parametrize("name", publication_names())
def test_published_labels_are_those_of_the_shipped_recipe(name: str) -> None:
    """Without rendering: draws and projections are the same on any machine."""
    publication, recipe = read_publication(name), load_recipe(name).recipe
    ours, theirs = (r.model_dump(mode="json", exclude={"drogue"}) for r in (recipe, publication.manifest.recipe))
    assert json.loads(json.dumps(ours)) == json.loads(json.dumps(theirs)), "`make publish` is due"
    assert len(publication.labels) == (PUBLISHED[name] or recipe.frames.count)
    assert [entry.frame_index for entry in publication.manifest.frames] == [k.frame_index for k in publication.labels]
    for labels in publication.labels[::4]:
        pose = sample_left_from_drogue(recipe, labels.frame_index)
        if pose is None or labels.pose is None:
            assert pose is None and labels.pose is None and labels.left is None
            continue
        # Rounded to nine decimals, of numbers that agree within 1e-9.
        np.testing.assert_allclose(labels.pose, pose.as_matrix()[:3].ravel(), rtol=2e-9, atol=2e-9)
        for eye, view in zip(EYES, (labels.left, labels.right), strict=True):
            assert view is not None
            if recipe.variants:
                continue
            box = drogue_box(recipe.drogue, recipe.rig, pose, eye)
            np.testing.assert_allclose(view.box_full_xywh_px, box, rtol=2e-9, atol=2e-9)
            centers_m = pose.apply(marker_layout(recipe.drogue).centers_m)
            published = [center[:2] for center in view.centers_px[: recipe.drogue.marker_count]]
            projected = recipe.rig.project(centers_m, eye)[: recipe.drogue.marker_count]
            np.testing.assert_allclose(published, projected, rtol=2e-9, atol=2e-9)
