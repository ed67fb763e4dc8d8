"""From the failures of a detector or an estimator to a recipe that draws more of what it fails at.

The objective: a share `kept` of the new frames follows the old law, so that nothing is forgotten; the others fall on
each bin of a law in proportion to the failures that the old law brings there,

    share = kept * share_before + (1 - kept) * share_before * failure_fraction / mean failure_fraction.

Each law has bins of its own: families of conditions, drogues, and distances. A bin's failure fraction is shrunk towards
the mean by a few cases' weight, so that two failures of two cases do not outweigh a hundred of a thousand.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.recipe.file_names import move_file_names
from datasets_manifest.recipe.recipe import MAX_SEED, NAME_PATTERN, Recipe, parse_recipe
from datasets_manifest.storage.layout import RECIPE_FILE
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, join, open_storage
from datasets_manifest.types.records import PairRecord
from drogue_models.frozen_model import FrozenModel
from drogue_models.untrusted_files import read_text
from droguekit.assurance.design_domain import bin_names
from droguekit.assurance.solved_cases import solved_cases
from droguekit.batch.progress import ProgressReport
from droguekit.batch.resume import differing_keys
from scenes.framing import distance_at

# A bin's failures count beside so many cases with the mean failure fraction.
_PRIOR_CASES = 4.0
_DIGITS = 4

# The bin of a case by family, drogue and distance; failures and cases by bin.
_Key = Callable[[str, str, float | None], str]
_Tally = Callable[[_Key], tuple[Counter[str], Counter[str]]]


class MinedBin(FrozenModel):
    """One bin of a law.

    Attributes:
        name: a family, a drogue, or a range of distances.
        before, after: share of the frames with a drogue, by the old recipe and by the new one.
        failures, cases: in the dataset.
        failure_fraction: shrunk towards the mean.
    """

    name: str
    before: float
    after: float
    failures: int
    cases: int
    failure_fraction: float


class MinedLaw(FrozenModel):
    """A law of a recipe before and after.

    Attributes:
        of: `families`, `distance`, `drogues`, or `drogues of FAMILY` where a family has its own.
        bins: all of its bins.
    """

    of: str
    bins: tuple[MinedBin, ...]


class MinedRecipe(FrozenModel):
    """A recipe that follows failures.

    Attributes:
        dataset, dataset_sha256: where they happened.
        scored: whose they are: a method of the estimates, or a file of detections.
        kept: share of the frames that follow the old laws.
        laws: that changed.
        text: the recipe, as TOML.
    """

    dataset: str
    dataset_sha256: str
    scored: str
    kept: float
    laws: tuple[MinedLaw, ...]
    text: str


@dataclass(frozen=True)
class MiningChoices:
    """How a recipe is mined.

    Attributes:
        scored: whose failures count, where files hold several methods.
        kept: share of the frames that follow the old laws.
        distance_bins: into which the distances are cut, equally many frames each by the old law.
        most_position_error_fraction: of the distance, up to which a pose is solved.
        seed: of the new recipe; None for the old one's plus 1.
        count: of its pairs, with scenes in proportion; None for as many as before.
        recipe: the TOML file that the dataset was rendered from, where `recipe.toml` does not say all.
    """

    scored: str | None = None
    kept: float = 0.5
    distance_bins: int = 8
    most_position_error_fraction: float = 0.01
    seed: int | None = None
    count: int | None = None
    recipe: Path | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.kept <= 1.0:
            raise ValueError(f"--kept: must be from 0 to 1, got {self.kept:g}")
        if not 1 <= self.distance_bins <= 100:
            raise ValueError(f"--distance-bins: must be from 1 to 100, got {self.distance_bins}")
        if not 0.0 < self.most_position_error_fraction <= 1.0:
            raise ValueError(
                f"--position-error: must be above 0 and at most 1, got {self.most_position_error_fraction:g}"
            )


def mine_recipe(
    dataset: Location,
    out: Path,
    choices: MiningChoices,
    estimates: Path | None = None,
    detections: Sequence[Path] = (),
    report: ProgressReport | None = None,
) -> MinedRecipe:
    """A recipe that draws more of what is not solved in a dataset; the same for the same arguments.

    Args:
        dataset: with its truth and its `recipe.toml`.
        out: TOML file that the recipe is meant for. Its stem is the recipe's name, which also keys its random streams;
            relative names of files are changed to be seen from its folder. The file is not written.
        choices: as named.
        estimates, detections: files of poses and of boxes; see `solved_cases`.
        report: is told of the progress, or None.

    Raises:
        ValueError: nothing is scored, nothing failed, or the recipe has no law to change; a file cannot be read.
    """
    if not re.fullmatch(NAME_PATTERN, out.stem):
        raise ValueError(
            f"--out: the file names the recipe, so it takes lower-case letters, digits and hyphens, got {out.name}"
        )
    source = Dataset(dataset)
    text, old = _recipe_of(source, choices.recipe)
    records: dict[int, tuple[str, str, float | None]] = {}

    def note(record: PairRecord) -> None:
        drogue = record.frame.drogue
        conditions = record.conditions
        records[record.frame_index] = conditions.family, "" if drogue is None else drogue.name, conditions.distance_m

    names, solved = solved_cases(source, choices.most_position_error_fraction, note, estimates, detections, report)
    chosen = _chosen(names, choices.scored)
    cases = {index: scores[chosen] for index, scores in solved.items() if chosen in scores}
    if not cases:
        raise ValueError(
            f"{source.path}: no pair has a drogue that {chosen} is to find; there is nothing to learn from"
        )
    if not any(hits < of for hits, of in cases.values()):
        raise ValueError(f"{source.path}: {chosen} solves every case; there is nothing to learn from")
    table = tomlkit.parse(text)
    laws = tuple(_change_laws(table, old, records, cases, choices))
    if not laws:
        raise ValueError(
            f"{source.path}: recipe: has one drogue, no families, and stations or one place for its distance; "
            "there is no law to weight"
        )
    table["name"] = out.stem
    move_file_names(table, choices.recipe.parent if choices.recipe else Path(), out.parent)
    table["seed"] = (old.seed + 1) % (MAX_SEED + 1) if choices.seed is None else choices.seed
    frames: Any = table["frames"]
    frames.pop("stream", None)
    if choices.count is not None:
        frames["count"] = choices.count
        if "scenes" in frames:
            frames["scenes"] = max(round(old.frames.scenes * choices.count / old.frames.count), 1)
    head = (
        f"# Mined from {source.manifest.name} ({source.manifest.dataset_sha256[:16]}) by the failures of {chosen}:\n"
        f"# {choices.kept:g} of the frames follow the laws of before, the others the failures under them.\n"
    )
    return MinedRecipe(
        dataset=source.manifest.name,
        dataset_sha256=source.manifest.dataset_sha256,
        scored=chosen,
        kept=choices.kept,
        laws=laws,
        text=head + tomlkit.dumps(table),
    )


def mined_lines(mined: MinedRecipe) -> Iterator[str]:
    """What a terminal shows: each law, bin by bin."""
    for law in mined.laws:
        yield f"{law.of}:"
        for place in law.bins:
            seen = f"{place.failures} of {place.cases} not solved" if place.cases else "no cases"
            yield f"  {place.name:<24} {100 * place.before:5.1f} % -> {100 * place.after:5.1f} %   {seen}"


def _chosen(names: Sequence[str], scored: str | None) -> str:
    if scored is None and len(names) == 1:
        return names[0]
    if scored in names:
        return str(scored)
    known = ", ".join(names) or "none; give --estimates or --detections"
    if scored is None:
        raise ValueError(f"--method: say whose failures count; there are {known}")
    raise ValueError(f"--method: no {scored!r} among the scored; there are {known}")


def _recipe_of(source: Dataset, given: Path | None) -> tuple[str, Recipe]:
    """Text of the recipe that a dataset was rendered from, and the recipe."""
    old = source.manifest.recipe
    if old.sequence is not None or old.frames.in_turn:
        raise ValueError(f"{source.path}: recipe: mining weights drawn frames, and this recipe has its own order")
    try:
        text = read_text(given) if given else open_storage(source.path).read(RECIPE_FILE).decode()
    except OSError as error:
        raise ValueError(f"{given or source.path}: the recipe cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{given or source.path}: the recipe is not valid UTF-8: {error}") from error
    try:
        # The command `render` takes seed and engine as options.
        engine = {"render": {"engine": old.render.engine}}
        read = parse_recipe(text, given.parent if given else None, old.seed, engine)
    except ValueError as error:
        raise ValueError(f"{given or RECIPE_FILE}: {error}; give the recipe's file with --recipe") from error
    read = read.model_copy(update={"frames": old.frames, "name": old.name})
    differing = differing_keys(read.model_dump(mode="json"), old.model_dump(mode="json"))
    if differing:
        raise ValueError(
            f"{given or join(source.path, RECIPE_FILE)}: differs in {', '.join(differing[:3])} from the recipe that "
            f"{source.path} was rendered from; give its file with --recipe"
        )
    return text, old


def _change_laws(
    table: Any,
    old: Recipe,
    records: Mapping[int, tuple[str, str, float | None]],
    cases: Mapping[int, tuple[int, int]],
    choices: MiningChoices,
) -> Iterator[MinedLaw]:
    """Weight the laws in a recipe's table, in place, and tell of each."""

    def tally(key_of: _Key) -> tuple[Counter[str], Counter[str]]:
        failures: Counter[str] = Counter()
        counts: Counter[str] = Counter()
        for index, (hits, of) in cases.items():
            failures[key_of(*records[index])] += of - hits
            counts[key_of(*records[index])] += of
        return failures, counts

    kept = choices.kept
    families = table.get("families", [])
    if len(old.families) > 1:
        weights = {family.name: family.weight for family in old.families}
        law = _mined("families", weights, *tally(lambda family, drogue, distance_m: family), kept)
        for family, place in zip(families, law.bins, strict=True):
            family["weight"] = round(place.after * len(law.bins), _DIGITS)
        yield law
    if old.distance.low_m is not None and old.distance.low_m != old.distance.high_m:
        edges_m, shares = _distance_bins(old.distance, choices.distance_bins)
        names = [f"{name} m" for name in bin_names(edges_m, fewest_digits=3)]

        def bin_of(family: str, drogue: str, distance_m: float | None) -> str:
            return names[min(max(int(np.searchsorted(edges_m, distance_m or 0.0, "right")) - 1, 0), len(names) - 1)]

        law = _mined("distance", dict(zip(names, shares, strict=True)), *tally(bin_of), kept)
        table["distance"]["edges_m"] = edges_m
        table["distance"]["weights"] = [round(place.after * len(names), _DIGITS) for place in law.bins]
        yield law
    yield from _change_drogue_laws(table, old, {family for family, _, _ in records.values()}, tally, kept)


def _change_drogue_laws(
    table: Any, old: Recipe, seen_families: AbstractSet[str], tally: _Tally, kept: float
) -> Iterator[MinedLaw]:
    """Weight the drogues of the recipe, and of the families that have their own; each by its own cases alone."""
    families = table.get("families", [])
    own = {family["name"] for family in families if "variants" in family.get("target", {})}
    laws = [("drogues", table.get("target", {}), old.target, seen_families - own)]
    for written, family in zip(families, old.families, strict=True):
        laws.append((f"drogues of {family.name}", written.get("target", {}), family.target, {family.name} & own))
    for of, part, target, users in laws:
        if len(part.get("variants", ())) < 2 or not users:
            continue
        by_drogue: dict[str, float] = defaultdict(float)
        for variant in target.variants:
            by_drogue[variant.drogue.name] += variant.weight
        law = _mined(of, by_drogue, *tally(partial(_drogue_in, users)), kept)
        grown = {place.name: place.after / place.before for place in law.bins}
        total = sum(by_drogue.values())
        for row, variant in zip(part["variants"], target.variants, strict=True):
            share = grown[variant.drogue.name] * variant.weight / total
            row["weight"] = round(share * len(target.variants), _DIGITS)
        yield law


def _drogue_in(users: AbstractSet[str], family: str, drogue: str, distance_m: float | None) -> str:
    return drogue if family in users else ""


def _distance_bins(law: DistanceLaw, count: int) -> tuple[list[float], list[float]]:
    """Edges of bins, and the share of the frames in each: those of the law, or equally many frames each."""
    if law.edges_m is not None and law.weights is not None:
        total = sum(law.weights)
        return list(law.edges_m), [weight / total for weight in law.weights]
    inner = sorted(float(f"{distance_at(law, place / count):.12g}") for place in range(1, count))
    return [float(law.low_m or 0.0), *inner, float(law.high_m or 0.0)], [1.0 / count] * count


def _mined(
    of: str, weights: Mapping[str, float], failures: Mapping[str, int], counts: Mapping[str, int], kept: float
) -> MinedLaw:
    """The new shares of a law; see the module."""
    total = math.fsum(weights.values())
    before = {name: weight / total for name, weight in weights.items()}
    cases = sum(counts.get(name, 0) for name in before)
    mean = sum(failures.get(name, 0) for name in before) / max(cases, 1)
    fractions = {
        name: (failures.get(name, 0) + _PRIOR_CASES * mean) / (counts.get(name, 0) + _PRIOR_CASES) for name in before
    }
    expected = math.fsum(before[name] * fractions[name] for name in before)
    bins = []
    for name, share in before.items():
        failing = share * fractions[name] / expected if expected > 0 else share
        bins.append(
            MinedBin(
                name=name,
                before=share,
                after=kept * share + (1.0 - kept) * failing,
                failures=failures.get(name, 0),
                cases=counts.get(name, 0),
                failure_fraction=fractions[name],
            )
        )
    return MinedLaw(of=of, bins=tuple(bins))
