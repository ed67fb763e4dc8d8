"""Datasets without a family of drogues or a type of tanker: nothing else is lost, and the corpus stays as it is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from datasets_manifest.storage.layout import EVENTS_FILE
from datasets_manifest.storage.reader import Dataset
from droguekit.api.recipe_rendering import load_recipe, render_dataset
from droguekit.cli.main import run
from scenes.sampler import sample_frame
from studies.unseen_families import __main__ as unseen_families
from studies.unseen_families.__main__ import FAMILIES, drogue_families_in, link_without, table_lines
from studies.world_variety.detection_by_kind import KindScore
from studies.world_variety.light_sheets import LIGHTS_RECIPE

DROGUES = FAMILIES["drogue"]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unseen") / "corpus"
    recipe = load_recipe(
        str(LIGHTS_RECIPE),
        drogue="red-8",
        render={"engine": "analytic"},
        rig={"preset": "rgb-ideal", "width_px": 160, "height_px": 120, "focal_px": 266.0},
        frames={"count": 6, "scenes": 6, "empty_fraction": 0.5},
    )
    render_dataset(recipe, folder, workers=0)
    return folder


def test_pairs_without_a_family_stay_and_the_corpus_is_not_changed(corpus: Path, tmp_path: Path) -> None:
    source = Dataset(corpus)
    families = {index: drogue_families_in(source.record(index).frame) for index in source.frame_indices}
    assert 0 < sum(seen == {"ring"} for seen in families.values()) < len(families)
    before = (source.manifest.dataset_sha256, (corpus / EVENTS_FILE).read_bytes())
    # As a run leaves it that was stopped while it linked.
    (tmp_path / "without.part" / "frames").mkdir(parents=True)
    for _ in range(2):
        kept = Dataset(link_without(corpus, DROGUES, "ring", tmp_path / "without"))
        assert list(kept.frame_indices) == [index for index, seen in families.items() if "ring" not in seen]
        assert all(kept.verify(index) == [] for index in kept.frame_indices)
        assert [entry.frame_index for entry in kept.manifest.frames] == list(kept.frame_indices)
    after = Dataset(corpus)
    assert before == (after.manifest.dataset_sha256, (corpus / EVENTS_FILE).read_bytes())
    assert all(after.verify(index) == [] for index in after.frame_indices)


def test_a_family_that_nobody_draws_or_that_is_everywhere_is_named(corpus: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="fuselage: choose from ring, basket, petals, ribbons, cone"):
        link_without(corpus, DROGUES, "fuselage", tmp_path / "none")
    recipe = load_recipe(str(LIGHTS_RECIPE), drogue="red-8", render={"engine": "analytic"}, frames={"count": 1})
    render_dataset(recipe, tmp_path / "rings", workers=0)
    with pytest.raises(ValueError, match="corpus: no pair shows a drogue of the family cone"):
        link_without(corpus, DROGUES, "cone", tmp_path / "none")
    with pytest.raises(ValueError, match="rings: every pair shows a drogue of the family ring"):
        link_without(tmp_path / "rings", DROGUES, "ring", tmp_path / "none")


def test_a_frame_counts_for_the_type_of_tanker_that_is_in_sight() -> None:
    plain = load_recipe(str(LIGHTS_RECIPE), frames={"count": 1})
    types = [{"type": "four-jet"}, {"type": "fighter"}]
    flown = load_recipe(str(LIGHTS_RECIPE), tanker={"variants": types}, frames={"count": 8, "scenes": 8})
    seen = [FAMILIES["tanker"].seen_in(sample_frame(flown, index)) for index in range(8)]
    assert {"four-jet"} in seen and {"fighter"} in seen and all(len(kinds) == 1 for kinds in seen)
    assert FAMILIES["tanker"].seen_in(sample_frame(plain, 0)) == {"wing"}


def test_the_command_trains_without_each_family_and_prints_its_rows(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trainings and scores are stood in for; they have tests of their own."""
    trained: list[tuple[Path, str, int]] = []

    def train(learned_from: Path, out: Path, cache: Path, image_passes: int, seed: int) -> Path:
        shown = [drogue_families_in(Dataset(learned_from).record(i).frame) for i in Dataset(learned_from).frame_indices]
        trained.append((out, "ring" if {"ring"} in shown else "no ring", image_passes))
        return out / "best.onnx"

    def score(test: Path, network: str, kind_of: object) -> Iterator[KindScore]:
        assert test == corpus and kind_of is DROGUES.kind_of
        yield KindScore("ring", 3, 3, 0.5, 0.9 if "everything" in network else 0.4, 0.8, 0)

    monkeypatch.setattr(unseen_families, "train_briefly", train)
    monkeypatch.setattr(unseen_families, "score_by_kind", score)
    command, out = typer.Typer(), tmp_path / "out"
    command.command()(unseen_families.main)
    words = ["--corpus", str(corpus), "--test", str(corpus), "--out", str(out), "--image-passes", "64"]
    assert run([*words, "--family", "cone", "--family", "ring"], command) == 0
    assert trained == [(out / "everything", "ring", 64), (out / "without-ring", "no ring", 64)]
    told = capsys.readouterr()
    assert told.out.splitlines()[2:] == ["| ring | 3 | 3 | 90.0 % | 40.0 % |"]
    assert "no pair shows a drogue of the family cone; it is not left out" in told.err

    def fail(*_: object) -> Path:
        raise OSError("everything.log: the training failed")

    monkeypatch.setattr(unseen_families, "train_briefly", fail)
    assert run(words, command) == 2
    assert capsys.readouterr().err == "unseen_families: error: everything.log: the training failed\n"


def test_rows_are_those_of_the_family() -> None:
    learned = [KindScore("basket", 4, 4, 0.5, 0.9, 0.8, 0), KindScore("basket, no markers", 6, 7, 0.4, 0.8, 0.7, 1)]
    learned += [KindScore("cone", 2, 2, 0.6, 1.0, 1.0, 0), KindScore("all", 12, 13, 0.5, 0.85, 0.8, 1)]
    unseen = [score._replace(ap50=None if score.kind == "cone" else (score.ap50 or 0.0) / 2) for score in learned]
    assert list(table_lines(DROGUES, "basket", learned, unseen)) == [
        "| basket | 4 | 4 | 90.0 % | 45.0 % |",
        "| basket, no markers | 6 | 7 | 80.0 % | 40.0 % |",
    ]
    assert list(table_lines(DROGUES, "cone", learned, unseen)) == ["| cone | 2 | 2 | 100.0 % | - |"]
    assert DROGUES.family_of("petals, no markers") == "petals"
    tankers = [
        score._replace(kind=kind) for score, kind in zip(learned, ("fighter", "four-jet", "wing", "all"), strict=True)
    ]
    assert list(table_lines(FAMILIES["tanker"], "four-jet", tankers, tankers)) == [
        "| four-jet | 6 | 7 | 80.0 % | 80.0 % |"
    ]
