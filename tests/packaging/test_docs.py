"""What README and docs point at is there: links, headings, commands, examples."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import droguekit
from datasets_manifest.recipe.recipe import FrameCounts, Recipe, load_recipe
from datasets_manifest.recipe.rigs import _RigTable
from datasets_manifest.recipe.sequence_ranges import MOST_SEQUENCE_S
from datasets_manifest.types.estimates import NoFix, PoseEstimate, read_estimates, write_estimates
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import MAX_MARKERS
from drogue_models.presets import PRESETS, load_drogue
from droguekit.cli.main import COMMANDS, DONE, FAULT, INTERRUPTED, WRONG_INPUT, load_command
from droguekit.workflows.rendering import MOST_TIMEOUT_S
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, paper_rig
from nav.pair_navigator import BINARY_METHODS, RIM_METHODS
from nav.pose.method_registry import ENTRY_POINT_GROUP, METHODS
from nav.pose.pose_method import Observation, Solution
from nav.runner import method_names

REPOSITORY = Path(__file__).resolve().parents[2]
PLACES = ("*.md", "docs/**/*.md", "studies/*/*.md", "tests/*/*.md")
PAGES = sorted(page for pattern in PLACES for page in REPOSITORY.glob(pattern))

CODE = ("geometry", "drogue_models", "datasets_manifest", "scenes", "render", "labelgen", "nav", "droguekit", "studies")


def text(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and GitLab make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def code_blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_commands_and_their_options_exist(page: Path) -> None:
    for line in re.findall(r"^droguekit (.+)$", "".join(code_blocks(page, "")), re.MULTILINE):
        name, *words = line.split("#")[0].split()
        assert name in COMMANDS, line
        options = {option for parameter in load_command(name).params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options, line


def test_limits_are_those_of_the_code() -> None:
    page = text("docs/reference/limits.md")
    rows = re.findall(r"^\| .* \| (\d+)[^|]* \| `([a-z_.]+)\.([A-Z_]+)` \|$", page, re.MULTILINE)
    assert len(rows) > 20
    for number, module, constant in rows:
        assert int(number) == getattr(importlib.import_module(module), constant), constant
    frames, table = FrameCounts.model_fields, _RigTable.model_fields
    limits = {
        "pairs": frames["count"].metadata[1].le,
        "scenes": frames["scenes"].metadata[1].le,
        "families": Recipe.model_fields["families"].metadata[0].max_length,
        "width or height of an image": table["width_px"].metadata[1].le,
        "time from a sequence's first pair to its last": int(MOST_SEQUENCE_S),
        "markers of a drogue": MAX_MARKERS,
        "time for a frame (`--timeout`)": int(MOST_TIMEOUT_S),
    }
    for name, limit in limits.items():
        assert re.search(rf"^\| {re.escape(name)} \| {limit} ", page, re.MULTILINE), name
    codes = {"done": DONE, "the work found a fault": FAULT, "wrong usage or input": WRONG_INPUT}
    for meaning, code in {**codes, "interrupted": INTERRUPTED}.items():
        assert re.search(rf"^\| {code} \| {meaning}", page, re.MULTILINE), meaning


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", text("Makefile"), re.MULTILINE))
    named = {target for page in PAGES for target in re.findall(r"`?make ([a-z-]+)`", page.read_text(encoding="utf-8"))}
    assert named and named <= targets


def test_files_named_in_the_docs_exist() -> None:
    # Whole code spans, and files of tests in commands.
    pattern = rf"`((?:{'|'.join(CODE)}|tests|docs)/[\w/.]+)`|\b(tests/[\w/]+\.py)\b"
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    named = {name for text in texts for pair in re.findall(pattern, text) for name in pair if name}
    assert named and [name for name in sorted(named) if "NAME" not in name and not (REPOSITORY / name).exists()] == []


def test_the_example_of_an_estimates_file_can_be_read(tmp_path: Path) -> None:
    (example,) = code_blocks(REPOSITORY / "docs/reference/benchmark.md", "json")
    (tmp_path / "estimates.jsonl").write_text(example, encoding="utf-8")
    assert [estimate.status for estimate in read_estimates(tmp_path / "estimates.jsonl")] == ["fix", "no_fix"]


def test_the_examples_of_a_recipe_and_of_blinking_lamps_can_be_read(tmp_path: Path) -> None:
    example, code = code_blocks(REPOSITORY / "docs/how-to/add-a-drogue.md", "toml")
    ring = 'name = "six"\nmarker_count = 6\nmarker_ring_radius_m = 0.27\nmarker_luminance_cd_m2 = 20000\n'
    (tmp_path / "six.toml").write_text(ring + code, encoding="utf-8")
    assert sum(load_drogue("six.toml", tmp_path).lit_fractions(0.0, 0.01)) == 5
    (tmp_path / "my-recipe.toml").write_text(example, encoding="utf-8")
    (tmp_path / "my-drogue.toml").write_text(text("drogue_models/examples/seven-markers.toml"), encoding="utf-8")
    assert load_recipe(str(tmp_path / "my-recipe.toml")).recipe.drogue.name == "seven-markers"


def test_the_example_of_a_method_finds_a_pose() -> None:
    (entry,) = code_blocks(REPOSITORY / "docs/how-to/add-an-estimator.md", "toml")
    (example,) = code_blocks(REPOSITORY / "docs/how-to/add-an-estimator.md", "python")
    (name,) = tomllib.loads(entry)["project"]["entry-points"][ENTRY_POINT_GROUP]
    namespace: dict[str, Any] = {}
    exec(compile(example, "adding-an-estimator.md", "exec", dont_inherit=True), namespace)
    rig, layout = paper_rig(), marker_layout(PRESETS["red-8"])
    points = RigidTransform(np.eye(3), np.array([0.06, 0.0, 5.0])).apply(layout.centers_m)
    pixels = np.stack([rig.project(points, eye) for eye in EYES])
    answer = namespace[name](Observation(rig, layout, pixels, np.tile(0.01 * np.eye(2), (2, layout.count, 1, 1))))
    assert isinstance(answer, Solution)
    # Centres of facing discs are those of their images; pixels of 1e3 in float64.
    np.testing.assert_allclose(answer.left_from_drogue.translation_m, [0.06, 0.0, 5.0], atol=1e-9)


def test_the_table_of_poses_holds_those_of_the_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = code_blocks(REPOSITORY / "docs/how-to/compare-poses.md", "python")
    monkeypatch.chdir(tmp_path)
    pose = RigidTransform(rotation_from_angles(0.1, -0.2, 0.3), np.array([0.06, -0.1, 5.0]))
    fix = PoseEstimate(
        frame_index=1, method="joint-hub", left_from_drogue=pose, covariance=np.diag([1.0, 4.0, 9.0, 0, 0, 0]) * 1e-6
    )
    others = NoFix(frame_index=0, method="joint-hub", reason="dark"), fix.model_copy(update={"method": "paper"})
    stamped = fix.model_copy(update={"frame_index": 2, "time_s": 12.25})
    write_estimates(Path("estimates.jsonl"), (*others, fix, stamped))
    record = Path("data/flight7/frames/000001/record.json")
    record.parent.mkdir(parents=True)
    record.write_text('{"time_s": 0.04}')
    names: dict[str, Any] = {}
    exec(compile(example, "compare-poses.md", "exec", dont_inherit=True), names)
    write_estimates(Path("plain.jsonl"), (stamped.model_copy(update={"covariance": None}),))
    names["write_table"]("plain.jsonl", "plain.csv", "joint-hub")
    assert Path("plain.csv").read_text().splitlines()[1].startswith("12.25,0.06,-0.1,5.0,")
    table = np.genfromtxt("poses.csv", delimiter=",", names=True)
    assert table["time_s"].tolist() == [0.04, 12.25]
    for row in table:
        read = Rotation.from_quat([row[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
        np.testing.assert_allclose(read, pose.rotation, atol=1e-12)
        np.testing.assert_allclose([row[f"{axis}_m"] for axis in "xyz"], pose.translation_m, atol=1e-12)
        np.testing.assert_allclose([row[f"sigma_{axis}_m"] for axis in "xyz"], [1e-3, 2e-3, 3e-3], rtol=1e-12)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_test_named_in_the_docs_exists(page: Path) -> None:
    named = set(re.findall(r"`(test_\w+)`", page.read_text(encoding="utf-8")))
    tests = "".join(path.read_text(encoding="utf-8") for path in REPOSITORY.glob("tests/**/*.py"))
    assert named <= set(re.findall(r"^def (test_\w+)", tests, re.MULTILINE))
    assert named or page.name != "paper.md"


def test_pages_named_in_the_code_exist() -> None:
    code = [path for package in CODE for path in (REPOSITORY / package).rglob("*.py")]
    named = {
        name for path in code for name in re.findall(r"(?<!-)\bdocs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert named and [name for name in sorted(named) if not (REPOSITORY / name).exists()] == []


def test_the_table_of_methods_names_their_centroids() -> None:
    rows = re.findall(
        r"^\| (`[a-z]+[^|]*) \|.* \| (binary|edge|rim) \|$", text("docs/reference/methods.md"), re.MULTILINE
    )
    centroids = {name: kind for names, kind in rows for name in re.findall(r"`([^`]+)`", names)}
    kinds = dict.fromkeys(BINARY_METHODS, "binary") | dict.fromkeys(RIM_METHODS, "rim")
    assert centroids == {name: kinds.get(name, "edge") for name in method_names()}


@pytest.mark.parametrize(
    "recipe", sorted((REPOSITORY / "datasets_manifest/recipes").glob("*.toml")), ids=lambda p: p.stem
)
def test_recipes_that_ship_are_documented(recipe: Path) -> None:
    assert f"`{recipe.stem}`" in text("docs/reference/recipes.md")


def test_methods_and_drogues_that_ship_are_documented() -> None:
    table = text("docs/reference/methods.md")
    assert [name for name in method_names() if f"| `{name}` |" not in table] == []
    drogues = text("docs/how-to/add-a-drogue.md")
    assert [name for name in PRESETS if f"`{name}`" not in drogues] == []


def test_commands_that_ship_are_documented() -> None:
    page = text("docs/reference/commands.md")
    assert [name for name in COMMANDS if f"| `{name}` |" not in page] == []


def test_the_readme_counts_the_methods() -> None:
    (count,) = re.findall(r"The (\d+) methods that ship", text("README.md"))
    assert int(count) == len(METHODS)


def test_readme_is_short() -> None:
    assert len(text("README.md").splitlines()) <= 110


@pytest.mark.parametrize(
    "study", sorted(path.parent for path in REPOSITORY.glob("studies/*/__init__.py")), ids=lambda p: p.name
)
def test_studies_say_what_they_ask_and_what_they_found(study: Path) -> None:
    readme = (study / "README.md").read_text(encoding="utf-8")
    assert all(f"**{part}.**" in readme for part in ("Question", "Method", "How to run", "Results"))
    if study.name == "publish":  # its results are the published manifests
        return
    # Every section of results is dated and names its command, commit, machine and seed.
    results = (study / "RESULTS.md").read_text(encoding="utf-8")
    heads = re.findall(r"^\| date \| commit \|.*$", results, re.MULTILINE)
    assert heads and all("command" in head and "machine" in head for head in heads)


def test_citation_names_this_version() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with mkdocs: pip install 'droguekit[docs]'")
    citation = yaml.safe_load(text("CITATION.cff"))
    version = tomllib.loads(text("pyproject.toml"))["project"]["version"]
    assert {"cff-version", "message", "title", "authors", "license"} <= citation.keys()
    assert citation["version"] == version
    assert f"## [{version}] - {citation['date-released'].isoformat()}" in text("CHANGELOG.md")


def test_the_workflow_and_the_hooks_are_what_they_should_be() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with mkdocs: pip install 'droguekit[docs]'")
    jobs = yaml.safe_load(text(".github/workflows/ci.yml"))["jobs"]
    assert any(step.get("run") == "make test-slow" for step in jobs["slow"]["steps"])
    job = jobs["test"]
    # The oldest and the newest Python that the project is tested with.
    assert job["strategy"]["matrix"]["python-version"] == ["3.11", "3.14"] and len(job["strategy"]["matrix"]["os"]) >= 2
    (test,) = (step for step in job["steps"] if step.get("run") == "bash .ci/run")
    assert test["env"] == {"PYTHON": "python${{ matrix.python-version }}"}
    (local,) = yaml.safe_load(text(".pre-commit-config.yaml"))["repos"]
    assert [hook["id"] for hook in local["hooks"]] == ["ruff", "ruff-format", "lint-imports", "mypy"]


def test_the_pages_build_without_a_warning_and_fetch_nothing(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is missing: pip install 'droguekit[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) >= len(PAGES)
    fetched = re.compile(
        r"""<(?:script|img|iframe)[^>]*\ssrc="?https?:|<link[^>]*rel="?stylesheet[^>]*href="?https?:"""
    )
    assert [page.name for page in pages if fetched.search(page.read_text(encoding="utf-8"))] == []
    interface = (tmp_path / "reference" / "python-api.html").read_text(encoding="utf-8")
    public = [*droguekit.__all__, *(f"torch.{name}" for name in ("PairDataset", "RenderStream", "sample_of_pair"))]
    assert [name for name in public if f'id="droguekit.{name}"' not in interface] == []
    # Names that share a line of a docstring would be taken for a name and its type.
    assert re.findall(r"<b>\w+,</b>", interface) == []
    examples = sorted(path.name for path in (REPOSITORY / "docs" / "examples").iterdir() if path.is_file())
    assert examples == sorted(path.stem for path in (tmp_path / "examples").glob("*.html"))
