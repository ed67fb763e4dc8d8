"""Records everything that a refactoring must leave as it is, so that two commits can be compared.

A figure here is a hash or a short text that follows from code, recipe and seed alone: datasets, labels, estimates,
scores, losses, exported files and help texts, with times and versions taken out. It is the same on one machine whenever
the code does the same.

    python scripts/yardstick.py record --out before.json
    python scripts/yardstick.py record --out after.json      # on the other commit
    python scripts/yardstick.py compare before.json after.json

`record --only NAME` records a few of the parts. Compiled loops are cached beside their sources and may not see changes
of other files, so the caches are removed first.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
GOLDEN_FILES = ("tests/render/golden_render.npz", "tests/scenes/golden_surroundings.npz")
EXPORTS = ("coco", "yolo", "bop", "speed", "kitti", "tum", "masks", "opencv", "kalibr", "ros-camera-info", "blind")
# What differs between two runs of the same code.
_VOLATILE = re.compile(r"(_s|_ms|seconds|time|code_version|generated)$")
Record = dict[str, str]


def run(work: Path, *arguments: str, may_fail: bool = False) -> str:
    """Run Python with this repository's code first on its path, and return what it printed.

    Raises:
        RuntimeError: it failed.
    """
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "COLUMNS": "100", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, *arguments], cwd=work, env=environment, capture_output=True, text=True, check=False
    )
    if result.returncode != 0 and not may_fail:
        raise RuntimeError(f"{' '.join(arguments)}: exit code {result.returncode}\n{result.stdout}{result.stderr}")
    return result.stdout


def command(work: Path, *arguments: str, may_fail: bool = False) -> str:
    """Run the command line."""
    code = "from droguekit.cli.main import main; main()"
    return run(work, "-c", code, *arguments, may_fail=may_fail)


def digest(data: bytes | str) -> str:
    """A short hash."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[:16]


def steady(value: Any) -> Any:
    """JSON without the fields that hold times or versions."""
    if isinstance(value, dict):
        return {key: steady(each) for key, each in value.items() if not _VOLATILE.search(key)}
    if isinstance(value, list):
        return [steady(each) for each in value]
    return value


def steady_lines(path: Path) -> list[str]:
    """Lines of JSON without times and versions."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [json.dumps(steady(json.loads(line)), sort_keys=True) for line in lines]


def by_method(path: Path) -> Record:
    """Hash of the estimates of each method."""
    lines: dict[str, list[str]] = {}
    for line in steady_lines(path):
        lines.setdefault(json.loads(line)["method"], []).append(line)
    return {method: digest("\n".join(each)) for method, each in lines.items()}


def json_digest(path: Path) -> str:
    """Hash of a JSON file without times and versions."""
    return digest(json.dumps(steady(json.loads(path.read_text(encoding="utf-8"))), sort_keys=True))


def tree_digest(folder: Path) -> str:
    """Hash of names and contents of all files of a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return digest("\n".join(f"{path.relative_to(folder)} {digest(path.read_bytes())}" for path in files))


def rendered(work: Path, recipe: str, name: str, *options: str) -> Path:
    """A dataset, made if it is missing."""
    if not (work / name / "manifest.json").exists():
        command(work, "render", recipe, "--out", name, "--workers", "2", *options)
    return work / name


def dataset_sha256(folder: Path) -> str:
    """Hash of a dataset as its manifest gives it."""
    return str(json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["dataset_sha256"])


def smoke(work: Path) -> Record:
    """The shipped recipe `smoke`, its check, and its published manifest."""
    folder = rendered(work, "smoke", "smoke")
    published = command(work, "validate", "smoke", "--published", may_fail=True)
    return {"dataset": dataset_sha256(folder), "published": digest(published.replace(str(work), ""))}


def demo(work: Path) -> Record:
    """The first 16 pairs of `demo`: hash, detections, estimates of all methods, scores, exports."""
    folder = rendered(work, "demo", "demo", "--frames", "0:16")
    command(work, "detect", "demo", "--out", "boxes.json")
    command(work, "navigate", "demo", "--out", "estimates.jsonl")
    command(work, "benchmark", "demo", "--estimates", "estimates.jsonl", "--json", "demo.json", "--html", "demo.html")
    record = {"dataset": dataset_sha256(folder), "detections": json_digest(work / "boxes.json")}
    record |= {f"estimates/{name}": each for name, each in by_method(work / "estimates.jsonl").items()}
    record["benchmark"] = json_digest(work / "demo.json")
    for name in EXPORTS:
        out = f"export-{name}"
        shutil.rmtree(work / out, ignore_errors=True)
        command(work, "export", "demo", "--format", name, "--out", out, may_fail=True)
        record[f"export/{name}"] = tree_digest(work / out) if (work / out).exists() else "refused"
    return record


def flight(work: Path) -> Record:
    """A docking run: tracker, filter and smoother, and their scores."""
    folder = rendered(work, "docking-10m", "flight", "--engine", "analytic", "--frames", "0:60")
    loop = ("--method", "joint-hub", "--tracker", "bernoulli", "--filter", "--smooth")
    command(work, "navigate", "flight", *loop, "--out", "flight.jsonl")
    command(work, "benchmark", "flight", "--estimates", "flight.jsonl", "--json", "flight.json", "--html", "f.html")
    record = {"dataset": dataset_sha256(folder), "benchmark": json_digest(work / "flight.json")}
    return record | {f"estimates/{name}": each for name, each in by_method(work / "flight.jsonl").items()}


def recipes(work: Path) -> Record:
    """A few frames of every shipped recipe by the analytic engine: all weathers, motions, rigs and drogues."""
    code = """
from importlib.resources import files
print(*sorted(path.name.removesuffix(".toml") for path in (files("datasets_manifest") / "recipes").iterdir()))
"""
    record = {}
    for name in run(work, "-c", code).split():
        frames = "0:13" if name == "world-89" else "0:2"
        options = ("--workers", "2", "--frames", frames)
        out = f"recipes/{name}"
        (work / out).parent.mkdir(exist_ok=True)
        # What stands in the analytic engine's way, such as obstacles, is path-traced.
        command(work, "render", name, "--out", out, *options, "--engine", "analytic", may_fail=True)
        if not (work / out / "manifest.json").exists():
            command(work, "render", name, "--out", out, *options)
        record[name] = dataset_sha256(work / out)
    return record


def tiers(work: Path) -> Record:
    """Acceptance tiers c and d with few draws, from whichever place this commit keeps them in."""
    record = {}
    for tier in ("c", "d"):
        arguments = (tier, "--out", f"tier-{tier}", "--draws", "20")
        if (REPOSITORY / "studies").is_dir():
            run(work, "-m", "studies.acceptance", *arguments, may_fail=True)
        else:
            command(work, "bars", *arguments, may_fail=True)
        written = work / f"tier-{tier}" / "bars.json"
        if not written.exists():
            raise RuntimeError(f"tier {tier}: {written} was not written")
        record[tier] = json_digest(written)
    return record


def training(work: Path) -> Record:
    """Losses of a training of 20 steps, and the network that it exports."""
    rendered(work, "smoke", "smoke")
    shutil.rmtree(work / "training", ignore_errors=True)
    options = ("--variant", "s", "--image-passes", "160", "--size", "96x128", "--threads", "1")
    command(work, "train", "smoke", "--out", "training", *options)
    code = """
import hashlib, onnx, sys
model = onnx.load(sys.argv[1])
for tensor in model.graph.initializer:
    print(tensor.name, hashlib.sha256(tensor.SerializeToString()).hexdigest())
print([node.op_type for node in model.graph.node])
"""
    folder = work / "training"
    record = {name: digest(run(work, "-c", code, str(folder / name))) for name in ("detector.onnx", "last.onnx")}
    return record | {"losses": digest((folder / "losses.csv").read_bytes())}


def help_texts(work: Path) -> Record:
    """Help of every command."""
    code = "from droguekit.cli.main import COMMANDS; print(*COMMANDS)"
    names = run(work, "-c", code).split()
    return {name: digest(command(work, name, "--help")) for name in names} | {"all": digest(command(work, "--help"))}


def golden(work: Path) -> Record:
    """Golden files of the tests, and the version of the pixels."""
    version = run(work, "-c", "from render.version import RENDER_VERSION; print(RENDER_VERSION)").strip()
    return {"render version": version} | {
        name: digest((REPOSITORY / name).read_bytes()) for name in GOLDEN_FILES if (REPOSITORY / name).exists()
    }


PARTS: dict[str, Callable[[Path], Record]] = {
    "golden": golden,
    "help": help_texts,
    "smoke": smoke,
    "training": training,
    "demo": demo,
    "flight": flight,
    "recipes": recipes,
    "tiers": tiers,
}


def remove_compiled() -> None:
    """Remove all compiled loops and byte code of this repository."""
    for folder in REPOSITORY.rglob("__pycache__"):
        if ".venv" not in folder.parts and folder.is_dir():
            shutil.rmtree(folder, ignore_errors=True)


def record(out: Path, work: Path, parts: list[str]) -> None:
    """Record the parts and write them, sorted by name."""
    remove_compiled()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    found: Record = {}
    for part in parts:
        print(f"{part} ...", flush=True)
        try:
            found |= {f"{part}: {name}": value for name, value in PARTS[part](work).items()}
        except RuntimeError as error:
            found[f"{part}: failed"] = str(error)
            print(error, flush=True)
        out.write_text(json.dumps(dict(sorted(found.items())), indent=1) + "\n", encoding="utf-8")


def compare(before: Path, after: Path) -> int:
    """Print what differs; 1 where something does."""
    first, second = (json.loads(path.read_text(encoding="utf-8")) for path in (before, after))
    shared = first.keys() & second.keys()
    changed = sorted(name for name in shared if first[name] != second[name])
    for name in changed:
        print(f"differs: {name}: {first[name]} -> {second[name]}")
    for name in sorted(first.keys() ^ second.keys()):
        print(f"only {'before' if name in first else 'after'}: {name}")
    print(f"{len(shared) - len(changed)} of {len(first)} equal")
    return 1 if changed or first.keys() - second.keys() else 0


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    recording = actions.add_parser("record", help="record this commit's figures")
    recording.add_argument("--out", type=Path, required=True, help="file to write")
    recording.add_argument("--work", type=Path, default=REPOSITORY / "out" / "yardstick", help="folder for the runs")
    recording.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS), help="parts to record")
    comparing = actions.add_parser("compare", help="compare two records; exit code 1 where they differ")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.action == "compare":
        return compare(options.before, options.after)
    record(options.out.resolve(), options.work.resolve(), options.only)
    return 0


if __name__ == "__main__":
    sys.exit(main())
