"""Counts what a newcomer has to look through: modules, folders, modules with one importer, names that exist twice.

`python scripts/count_modules.py` prints four lines; with `--verbose` also which they are.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
from collections import Counter, defaultdict
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
# Neither product nor study.
_OUTSIDE = ("tests/", "scripts/", "docs/")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--verbose", action="store_true", help="list them")
    verbose = parser.parse_args().verbose
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    paths = [name for name in listed.stdout.split() if not name.startswith(_OUTSIDE)]
    modules = {name[:-3].replace("/", "."): name for name in paths if not name.endswith("__init__.py")}
    trees = {name: ast.parse((REPOSITORY / name).read_text(encoding="utf-8")) for name in paths}
    folders = Counter(name.rsplit("/", 1)[0] for name in modules.values())
    importers: defaultdict[str, set[str]] = defaultdict(set)
    classes: defaultdict[str, list[str]] = defaultdict(list)
    for name, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                for target in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                    if target in modules and modules[target] != name:
                        importers[target].add(name)
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].append(name)
    single = sorted((name, *importers[name]) for name in modules if len(importers[name]) == 1)
    twice = {name: places for name, places in sorted(classes.items()) if len(places) > 1}
    (largest, count), *_ = folders.most_common(1)
    print(f"modules: {len(modules)}")
    print(f"largest folder: {count} modules, {largest}")
    print(f"modules with exactly one importer: {len(single)}")
    for name, importer in single if verbose else ():
        print(f"  {name} <- {importer}")
    print(f"public class names that exist more than once: {len(twice)}")
    for name, places in twice.items() if verbose else ():
        print(f"  {name}: {', '.join(places)}")


if __name__ == "__main__":
    main()
