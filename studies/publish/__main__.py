"""Writes the published manifests: renders the small recipes and records the hashes of the results.

Run as `python -m studies.publish --work DIR --out datasets_manifest/published`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.release.publication import build_publication, publication_text
from droguekit.batch.execution import default_workers
from droguekit.batch.progress import ProgressReport, progress_report
from droguekit.batch.render_dataset import render_dataset

# By recipe how many pairs are published, from the first on; None for all. Each takes a minute or two at most.
PUBLISHED: Mapping[str, int | None] = {
    "smoke": None,
    "pose-tier-a": 36,
    "demo": None,
    "low-light": None,
    "cloud": None,
}


def publish(name: str, pairs: int | None, work: Path, out: Path, report: ProgressReport) -> Path:
    """Render a recipe from scratch and write its published manifest.

    Args:
        name: of a recipe that ships.
        pairs: how many, from the first on; None for all.
        work: folder for the dataset, which must not be there yet.
        out: folder of the published manifests.
        report: of progress.

    Returns:
        The file.

    Raises:
        ValueError: the dataset's folder is there already, or frames were dropped.
        OSError: a folder cannot be written.
    """
    dataset = work / name
    if dataset.exists():
        raise ValueError(f"{dataset}: exists already; published datasets are rendered from scratch, so delete it first")
    source = load_recipe(name)
    count = source.recipe.frames.count if pairs is None else pairs
    render_dataset(source, dataset, range(count), default_workers(), report)
    path = out / f"{name}.json"
    write_text_atomic(path, publication_text(build_publication(dataset)))
    return path


def main() -> int:
    """Publish the recipes that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m studies.publish", description=__doc__)
    parser.add_argument("recipes", nargs="*", metavar="RECIPE", help=f"of {', '.join(PUBLISHED)}; all by default")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="for the datasets")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for the published manifests")
    arguments = parser.parse_args()
    report = progress_report()
    try:
        for name in arguments.recipes or PUBLISHED:
            if name not in PUBLISHED:
                raise ValueError(f"recipes: {name!r} is not published; there are {', '.join(PUBLISHED)}")
            report.say(f"wrote {publish(name, PUBLISHED[name], arguments.work, arguments.out, report)}")
    except (ValueError, OSError) as error:
        print(f"publish: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
