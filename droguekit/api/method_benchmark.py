"""Scores of pose estimates, as numbers, a table and figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datasets_manifest.types.estimates import Estimate, read_estimates
from droguekit.api.stereo_dataset import StereoDataset
from droguekit.numerical_threads import one_thread
from droguekit.scoring.pose_benchmark import score_estimates
from droguekit.scoring.results.benchmark_result import BenchmarkResult

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class PoseScores:
    """Scores of every method of a file of estimates.

    Attributes:
        result: all numbers, as in `benchmark.json`.
    """

    result: BenchmarkResult

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods."""
        return tuple(self.result.methods)

    def to_frame(self) -> pd.DataFrame:
        """A table with a row for each method and bin of distance, and one over all distances.

        Returns:
            Columns `method`, `low_m`, `high_m` (missing in the row over all distances) and every number of
            `PoseRow`, with its unit in its name.

        Raises:
            ValueError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ValueError("pandas is missing: pip install 'droguekit[notebook]'") from error

        rows = []
        for method, scores in self.result.methods.items():
            for row in (scores.overall, *scores.bins):
                numbers = {key: value for key, value in row.model_dump().items() if not isinstance(value, (dict, list))}
                rows.append({"method": method, "low_m": None, "high_m": None, **numbers})
        return pd.DataFrame(rows)

    def plot(self, quantity: str = "position") -> Figure:
        """Root mean square error of every method against distance, with the bound.

        Args:
            quantity: `position`, `x`, `y`, `z`, `pitch` or `yaw`.

        Raises:
            ValueError: another quantity.
        """
        from droguekit.scoring.report.figures import QUANTITIES, error_figure

        by_name = {each.key.split("_")[0]: each for each in QUANTITIES}
        if quantity not in by_name:
            raise ValueError(f"quantity: must be one of {', '.join(by_name)}, got {quantity!r}")
        return error_figure(self.result, by_name[quantity])


def benchmark(dataset: StereoDataset | str | Path, estimates: str | Path | Iterable[Estimate]) -> PoseScores:
    """Compare estimates with the truth of a dataset.

    Args:
        dataset: with truth; a selection of pairs is scored on these pairs alone.
        estimates: a JSON-lines file as `droguekit navigate` writes it, or estimates of any origin, such as those of
            `Navigator`. A pair without an estimate of a method counts as not fixed.

    Raises:
        ValueError: the dataset or the file cannot be read, or estimates name pairs that the dataset lacks, or one
            twice for a method.
    """
    opened = dataset if isinstance(dataset, StereoDataset) else StereoDataset(dataset)
    reader = opened.reader
    not_selected = set(reader.frame_indices) - set(opened.frame_indices)
    if isinstance(estimates, (str, Path)):
        given, source = read_estimates(Path(estimates)), str(estimates)
    else:
        given, source = iter(estimates), "estimates"
    kept = (estimate for estimate in given if estimate.frame_index not in not_selected)
    with one_thread():
        return PoseScores(score_estimates(reader, kept, source, opened.frame_indices))
