"""What README and docs point at is there: links, headings, commands, examples."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from datasets_manifest.estimates import read_estimates
from datasets_manifest.recipe import load_recipe
from drogue_models.presets import PRESETS
from droguekit.cli.main import COMMANDS, load_command
from nav.runner import method_names

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted([REPOSITORY / "README.md", REPOSITORY / "CHANGELOG.md", *(REPOSITORY / "docs").glob("*.md")])


def text(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and GitLab make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def code_blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        if target.startswith("https://"):
            continue
        file, _, anchor = target.partition("#")
        linked = page.parent / file if file else page
        if not linked.exists() or (anchor and anchor not in anchors(linked)):
            broken.append(target)
    assert broken == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_their_options_exist(page: Path) -> None:
    for line in re.findall(r"^droguekit (.+)$", "".join(code_blocks(page, "")), re.MULTILINE):
        name, *words = line.split("#")[0].split()
        assert name in COMMANDS, line
        options = {option for parameter in load_command(name).params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options, line


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", text("Makefile"), re.MULTILINE))
    named = {target for page in PAGES for target in re.findall(r"`?make ([a-z-]+)`", page.read_text(encoding="utf-8"))}
    assert named and named <= targets


def test_files_named_in_the_docs_exist() -> None:
    pattern = (
        r"`((?:geometry|drogue_models|datasets_manifest|scenes|render|labelgen|nav|droguekit|tests|docs)/[\w/.]+)`"
    )
    named = {name for page in PAGES for name in re.findall(pattern, page.read_text(encoding="utf-8"))}
    assert named and [name for name in sorted(named) if "NAME" not in name and not (REPOSITORY / name).exists()] == []


def test_the_example_of_an_estimates_file_can_be_read(tmp_path: Path) -> None:
    (example,) = code_blocks(REPOSITORY / "docs/benchmark.md", "json")
    (tmp_path / "estimates.jsonl").write_text(example, encoding="utf-8")
    assert [estimate.status for estimate in read_estimates(tmp_path / "estimates.jsonl")] == ["fix", "no_fix"]


def test_the_example_of_a_recipe_can_be_read(tmp_path: Path) -> None:
    (example,) = code_blocks(REPOSITORY / "docs/adding-a-drogue.md", "toml")
    (tmp_path / "my-recipe.toml").write_text(example, encoding="utf-8")
    (tmp_path / "my-drogue.toml").write_text(text("drogue_models/examples/seven-markers.toml"), encoding="utf-8")
    assert load_recipe(str(tmp_path / "my-recipe.toml"))[0].drogue.name == "seven-markers"


def test_methods_and_drogues_that_ship_are_documented() -> None:
    table = text("docs/benchmark.md")
    assert [name for name in method_names() if f"| `{name}` |" not in table] == []
    drogues = text("docs/adding-a-drogue.md")
    assert [name for name in PRESETS if f"`{name}`" not in drogues] == []
