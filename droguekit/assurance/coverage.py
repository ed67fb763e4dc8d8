"""What a dataset covers of an operational design domain: pairs in each cell, and how well they are solved there."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import Field

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PairRecord
from drogue_models.frozen_model import FrozenModel
from droguekit.assurance.design_domain import Crossing, DesignDomain, Placed
from droguekit.assurance.solved_cases import SolvedCases, solved_cases
from droguekit.batch.progress import ProgressReport
from droguekit.scoring.confidence_intervals import Interval, fraction_interval
from droguekit.scoring.report.number_text import percent

_MOST_LINES = 20


class Share(FrozenModel):
    """How many of the cases in a cell were solved.

    Attributes:
        hits, count: solved cases, and all: pairs for poses, images for boxes.
        interval: 95 % confidence interval of the share, by Wilson's formula as if cases were independent.
    """

    hits: int
    count: int
    interval: Interval

    @property
    def interval_text(self) -> str:
        """Both ends in percent."""
        low, high = map(percent, self.interval)
        return f"{low.removesuffix(' %')} to {high}"


class DomainCell(FrozenModel):
    """One combination of bins.

    Attributes:
        bins: one of each crossed quantity.
        pairs: that lie in it.
        scores: by the name of a method or of a file of detections; only where there are cases.
    """

    bins: tuple[str, ...]
    pairs: int
    scores: dict[str, Share] = Field(default_factory=dict)


class CrossingCoverage(FrozenModel):
    """The cells of one crossing.

    Attributes:
        of: its quantities.
        fewest_pairs: that every cell needs.
        outside: pairs that lie outside of the bins of one of them.
        cells: all of them, the last quantity running fastest.
    """

    of: tuple[str, ...]
    fewest_pairs: int
    outside: int
    cells: tuple[DomainCell, ...]

    @property
    def lacking(self) -> tuple[DomainCell, ...]:
        """Cells with fewer pairs than they need."""
        return tuple(cell for cell in self.cells if cell.pairs < self.fewest_pairs)


class Coverage(FrozenModel):
    """What a dataset covers of a domain.

    Attributes:
        dataset, dataset_sha256: which one.
        domain: name of the domain.
        pairs: of the dataset.
        outside: pairs that lie outside of all bins of a quantity, by quantity; pairs for which it has no meaning, such
            as a distance without a drogue, do not count.
        scored: names in the cells' scores.
        crossings: as in the domain.
    """

    dataset: str
    dataset_sha256: str
    domain: str
    pairs: int
    outside: dict[str, int]
    scored: tuple[str, ...]
    crossings: tuple[CrossingCoverage, ...]

    @property
    def is_complete(self) -> bool:
        """Whether every cell has the pairs that it needs."""
        return not any(crossing.lacking for crossing in self.crossings)


@dataclass
class _Tally:
    """Pairs and solved cases by cell."""

    pairs: Counter[tuple[str, ...]] = field(default_factory=Counter)
    hits: dict[str, Counter[tuple[str, ...]]] = field(default_factory=lambda: defaultdict(Counter))
    counts: dict[str, Counter[tuple[str, ...]]] = field(default_factory=lambda: defaultdict(Counter))
    outside: int = 0


def measure_coverage(
    dataset: Location,
    domain: DesignDomain,
    estimates: Path | None = None,
    detections: Sequence[Path] = (),
    report: ProgressReport | None = None,
) -> Coverage:
    """Count the pairs in each cell of a domain, and the solved ones where there are estimates or detections.

    See `solved_cases` for what is solved.

    Args:
        dataset: with its truth.
        domain: whose cells are counted.
        estimates: file of poses.
        detections: files of COCO results.
        report: is told of the progress, or None.

    Raises:
        ValueError: no such dataset, or a record or file that cannot be read.
    """
    source = Dataset(dataset)
    placed: dict[int, dict[str, Placed]] = {}

    def place(record: PairRecord) -> None:
        placed[record.frame_index] = domain.bins_of(record)

    names, solved = solved_cases(source, domain.most_position_error_fraction, place, estimates, detections, report)
    return Coverage(
        dataset=source.manifest.name,
        dataset_sha256=source.manifest.dataset_sha256,
        domain=domain.name,
        pairs=len(source.frame_indices),
        outside={
            name: sum(bins[name].applies and bins[name].bin is None for bins in placed.values())
            for name in domain.quantities
        },
        scored=names,
        crossings=tuple(_crossing(domain, crossing, placed, solved) for crossing in domain.cells),
    )


def _crossing(
    domain: DesignDomain,
    crossing: Crossing,
    placed: dict[int, dict[str, Placed]],
    solved: SolvedCases,
) -> CrossingCoverage:
    tally = _Tally()
    for index, bins in placed.items():
        own = [bins[name] for name in crossing.of]
        if not all(place.applies for place in own):
            continue
        cell = tuple(place.bin for place in own if place.bin is not None)
        if len(cell) < len(own):
            tally.outside += 1
            continue
        tally.pairs[cell] += 1
        for name, (hits, count) in solved[index].items():
            tally.hits[name][cell] += hits
            tally.counts[name][cell] += count
    cells = []
    for cell in domain.cells_of(crossing):
        scores = {
            name: Share(
                hits=tally.hits[name][cell],
                count=counts[cell],
                interval=fraction_interval(tally.hits[name][cell], counts[cell]),
            )
            for name, counts in tally.counts.items()
            if counts[cell]
        }
        cells.append(DomainCell(bins=cell, pairs=tally.pairs[cell], scores=scores))
    return CrossingCoverage(
        of=crossing.of, fewest_pairs=crossing.fewest_pairs, outside=tally.outside, cells=tuple(cells)
    )


def coverage_lines(coverage: Coverage) -> Iterator[str]:
    """What a terminal shows: each crossing in a line, and the cells that lack pairs."""
    yield f"{coverage.dataset}: {_counted(coverage.pairs, 'pair')} against the domain {coverage.domain}"
    for name, pairs in coverage.outside.items():
        if pairs:
            yield f"outside the domain's {name}: {_counted(pairs, 'pair')}"
    for crossing in coverage.crossings:
        lacking = crossing.lacking
        state = f"{len(lacking)} {'lacks' if len(lacking) == 1 else 'lack'} pairs" if lacking else "all have enough"
        cells = f"{_counted(len(crossing.cells), 'cell')}, each to have {_counted(crossing.fewest_pairs, 'pair')}"
        yield f"{' x '.join(crossing.of)}: {cells}: {state}"
        for cell in lacking[:_MOST_LINES]:
            yield f"  {cell_name(crossing, cell)}: {_counted(cell.pairs, 'pair')}"
        if len(lacking) > _MOST_LINES:
            yield f"  and {len(lacking) - _MOST_LINES} more"
        for name in coverage.scored:
            worst = worst_cell(crossing, name)
            if worst is None:
                continue
            share = worst.scores[name]
            yield (
                f"  {name} solved every case"
                if share.hits == share.count
                else f"  {name} is worst at {cell_name(crossing, worst)}: {share.hits} of {share.count} solved, "
                f"{share.interval_text}"
            )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def cell_name(crossing: CrossingCoverage, cell: DomainCell) -> str:
    """A cell in words."""
    return ", ".join(f"{name} {bin_name}" for name, bin_name in zip(crossing.of, cell.bins, strict=True))


def worst_cell(crossing: CrossingCoverage, name: str) -> DomainCell | None:
    """The cell whose share is surely lowest: the one with the lowest upper end of the interval; None without cases."""
    scored = [cell for cell in crossing.cells if name in cell.scores]
    return min(scored, key=lambda cell: cell.scores[name].interval[1], default=None)
