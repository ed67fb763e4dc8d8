"""Runs the parts of the comparison in turn, and keeps each result on disk, so that a stopped run can resume."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import RenderSettings
from render.engine import RenderEngine, load_engine
from studies.engine_agreement.agreement import compare_frame
from studies.engine_agreement.agreement_report import frame_row, write_picture
from studies.engine_agreement.costs import COST_FAMILY, COST_STATIONS_M, CostComparison, cost_from_row, measure_costs
from studies.engine_agreement.measures import TILTS_DEG, PlateIlluminance, compare_plate, plate_frame
from studies.engine_agreement.paired_frames import PairedFrame, frame_at, recipe_of_family

Result = dict[str, Any]


class ResultStore:
    """A folder of results; each names the inputs it was computed from, and is valid for these alone."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str, made_from: Result) -> Result | None:
        """The stored result of this name and these inputs, or None."""
        try:
            stored = json.loads(self._file(name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        # As JSON has it: tuples are lists there.
        same = isinstance(stored, dict) and stored.get("made_from") == json.loads(json.dumps(made_from))
        return stored["found"] if same else None

    def keep(self, name: str, made_from: Result, result: Result) -> None:
        """Store a result; the file is written completely or not at all.

        Raises:
            OSError: it cannot be written.
        """
        write_text_atomic(self._file(name), json.dumps({"made_from": made_from, "found": result}, indent=1) + "\n")

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.json"


class Engines:
    """Two engines, loaded when they or their versions are first needed."""

    def __init__(self, names: tuple[str, str]) -> None:
        self.names = names

    @cached_property
    def both(self) -> tuple[RenderEngine, RenderEngine]:
        """The engines.

        Raises:
            ValueError: one cannot be used.
        """
        return load_engine(self.names[0]), load_engine(self.names[1])

    @cached_property
    def compiled(self) -> tuple[RenderEngine, RenderEngine]:
        """The engines after their first pictures, which include compilation."""
        measure_costs(COST_STATIONS_M[0], 0, *self.both)
        return self.both

    @property
    def versions(self) -> list[str]:
        """Versions of both engines, down to the version of their pixels."""
        return [engine.version for engine in self.both]


@dataclass(frozen=True)
class ComparisonRun:
    """One run of the comparison.

    Attributes:
        out: folder for results and pictures.
        engines: the two engines.
        seed: of all frames.
        say: called with a line about each result.
    """

    out: Path
    engines: Engines
    seed: int
    say: Callable[[str], None]

    def frames(self, frames: Sequence[PairedFrame], line: Callable[[Result], str]) -> list[Result]:
        """Every frame by both engines; pictures in `frames`.

        Raises:
            ValueError: an engine cannot render a frame.
            OSError: a result cannot be written.
        """
        rows = []
        for index, paired in enumerate(frames):
            made_from = {"frame_sha256": _sha256(paired.frame.model_dump_json(), paired.settings.model_dump_json())}
            rows.append(self._result(f"frame-{index:03d}", made_from, partial(self._frame, index, paired)))
            self.say(line(rows[-1]))
        return rows

    def _frame(self, index: int, paired: PairedFrame) -> Result:
        compared = compare_frame(paired, *self.engines.both)
        write_picture(self.out / "frames" / f"{index:03d}.png", compared)
        return frame_row(compared)

    def plates(self, samples: int, line: Callable[[PlateIlluminance], str]) -> list[PlateIlluminance]:
        """Illuminance of all plates.

        Raises:
            OSError: a result cannot be written.
        """
        plates = []
        for number, tilt in enumerate(TILTS_DEG):
            frame, settings = plate_frame(samples, tilt)
            made_from = {"frame_sha256": _sha256(frame.model_dump_json(), settings.model_dump_json())}
            row = self._result(f"plate-{number}", made_from, partial(self._plate, tilt, samples))
            plates.append(PlateIlluminance(**row))
            self.say(line(plates[-1]))
        return plates

    def _plate(self, tilt_deg: tuple[float, float], samples: int) -> Result:
        return vars(compare_plate(tilt_deg, samples, *self.engines.both))

    def costs(self, line: Callable[[CostComparison], str]) -> list[CostComparison]:
        """Cost and noise of a pair at all distances, from far to near.

        Raises:
            OSError: a result cannot be written.
        """
        costs = []
        for distance_m in COST_STATIONS_M:
            frame = frame_at(recipe_of_family(COST_FAMILY, self.seed), distance_m, 1, 0)
            made_from = {"distance_m": distance_m, "sha256": _sha256(frame.model_dump_json(), str(RenderSettings()))}
            row = self._result(f"cost-{distance_m:g}m", made_from, partial(self._cost, distance_m))
            costs.append(cost_from_row(row))
            self.say(line(costs[-1]))
        return costs

    def _cost(self, distance_m: float) -> Result:
        return measure_costs(distance_m, self.seed, *self.engines.compiled).row()

    def _result(self, name: str, made_from: dict[str, Any], compute: Callable[[], Result]) -> Result:
        store = ResultStore(self.out / "found")
        whole = made_from | {"engines": self.engines.versions}
        stored = store.get(name, whole)
        if stored is not None:
            return stored
        result = compute()
        store.keep(name, whole, result)
        return result


def _sha256(*texts: str) -> str:
    return hashlib.sha256("".join(texts).encode()).hexdigest()
