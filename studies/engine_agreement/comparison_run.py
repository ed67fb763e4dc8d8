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
from studies.engine_agreement.costs import COST_FAMILY, COST_STATIONS_M, CostComparison, cost_of, measure_costs
from studies.engine_agreement.measures import TILTS_DEG, PlateIlluminance, compare_plate, plate_frame
from studies.engine_agreement.paired_frames import PairedFrame, frame_at, recipe_of_family

Found = dict[str, Any]


class ResultStore:
    """A folder of found things; each names what it was made from, and counts for nothing else."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str, made_from: Found) -> Found | None:
        """What was found under this name from the same things, None if nothing was."""
        try:
            kept = json.loads(self._file(name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        # As JSON has it: tuples are lists there.
        same = isinstance(kept, dict) and kept.get("made_from") == json.loads(json.dumps(made_from))
        return kept["found"] if same else None

    def keep(self, name: str, made_from: Found, found: Found) -> None:
        """Keep what was found; the file is there whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        write_text_atomic(self._file(name), json.dumps({"made_from": made_from, "found": found}, indent=1) + "\n")

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.json"


class Engines:
    """Two engines, loaded when they or their versions are first asked for."""

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
        """The engines after their first pictures, which pay for compiling."""
        measure_costs(COST_STATIONS_M[0], 0, *self.both)
        return self.both

    @property
    def versions(self) -> list[str]:
        """Down to what changes pixels."""
        return [engine.version for engine in self.both]


@dataclass(frozen=True)
class ComparisonRun:
    """Where it happens.

    Attributes:
        out: folder of all that is written.
        engines: which two.
        seed: of all that is drawn.
        say: takes a line about what was found.
    """

    out: Path
    engines: Engines
    seed: int
    say: Callable[[str], None]

    def frames(self, frames: Sequence[PairedFrame], line: Callable[[Found], str]) -> list[Found]:
        """Every frame by both engines; pictures in `frames`.

        Raises:
            ValueError: an engine refuses a frame.
            OSError: a finding cannot be written.
        """
        rows = []
        for index, paired in enumerate(frames):
            made_from = {"frame_sha256": _sha256(paired.frame.model_dump_json(), paired.settings.model_dump_json())}
            rows.append(self._found(f"frame-{index:03d}", made_from, partial(self._frame, index, paired)))
            self.say(line(rows[-1]))
        return rows

    def _frame(self, index: int, paired: PairedFrame) -> Found:
        compared = compare_frame(paired, *self.engines.both)
        write_picture(self.out / "frames" / f"{index:03d}.png", compared)
        return frame_row(compared)

    def plates(self, samples: int, line: Callable[[PlateIlluminance], str]) -> list[PlateIlluminance]:
        """Light on all plates.

        Raises:
            OSError: a finding cannot be written.
        """
        plates = []
        for number, tilt in enumerate(TILTS_DEG):
            frame, settings = plate_frame(samples, tilt)
            made_from = {"frame_sha256": _sha256(frame.model_dump_json(), settings.model_dump_json())}
            row = self._found(f"plate-{number}", made_from, partial(self._plate, tilt, samples))
            plates.append(PlateIlluminance(**row))
            self.say(line(plates[-1]))
        return plates

    def _plate(self, tilt_deg: tuple[float, float], samples: int) -> Found:
        return vars(compare_plate(tilt_deg, samples, *self.engines.both))

    def costs(self, line: Callable[[CostComparison], str]) -> list[CostComparison]:
        """Cost and noise of a pair at all distances, from far to near.

        Raises:
            OSError: a finding cannot be written.
        """
        costs = []
        for distance_m in COST_STATIONS_M:
            frame = frame_at(recipe_of_family(COST_FAMILY, self.seed), distance_m, 1, 0)
            made_from = {"distance_m": distance_m, "sha256": _sha256(frame.model_dump_json(), str(RenderSettings()))}
            row = self._found(f"cost-{distance_m:g}m", made_from, partial(self._cost, distance_m))
            costs.append(cost_of(row))
            self.say(line(costs[-1]))
        return costs

    def _cost(self, distance_m: float) -> Found:
        return measure_costs(distance_m, self.seed, *self.engines.compiled).row()

    def _found(self, name: str, made_from: dict[str, Any], find: Callable[[], Found]) -> Found:
        findings = ResultStore(self.out / "found")
        whole = made_from | {"engines": self.engines.versions}
        kept = findings.get(name, whole)
        if kept is not None:
            return kept
        found = find()
        findings.keep(name, whole, found)
        return found


def _sha256(*texts: str) -> str:
    return hashlib.sha256("".join(texts).encode()).hexdigest()
