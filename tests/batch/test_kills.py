"""SIGKILL at random instants, and a disk, a home and frames that go away: the dataset is as without them."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage import layout
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.writer import leftovers
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.batch_datasets import ANALYTIC_RECIPE, file_hashes, render_recipe

# A look at the folder this often; what is awaited may take as long as the machine needs.
_LOOK_EVERY_S = 0.02
# In what surroundings a run starts, and what happens to its finished frames meanwhile.
SURROUNDINGS = ("usual", "usual", "no home", "full disk", "nobody listens")
HARMS = ("none", "vanished frame", "damaged file", "half a frame")
LOOP_HARM = "damaged loop"


class KilledRun:
    """A run in processes of its own that is killed now and then, and started again whenever it has ended."""

    def __init__(
        self, recipe: Path, out: Path, scratch: Path, rng: np.random.Generator, loops: Path | None = None
    ) -> None:
        """Nothing runs yet; `loops` keeps compiled loops, to be damaged too."""
        self._command = [sys.executable, "-m", "droguekit.cli.main", "render", str(recipe), "--out", str(out)]
        self._out, self._rng = out, rng
        self._environment = {"XDG_CACHE_HOME": "", **os.environ, "TMPDIR": str(scratch)}
        self._loops = loops
        if loops is not None:
            self._environment["NUMBA_CACHE_DIR"] = str(loops)
        self._process: subprocess.Popen[bytes] | None = None
        self.kills = 0
        self.faults: Counter[str] = Counter()

    def go_on_until(self, is_reached: Callable[[], bool], longest_s: float) -> bool:
        """Let it run until a condition holds, and then for a random time of up to `longest_s`.

        Returns:
            Whether it is still at work.
        """
        if self._process is None or self._process.poll() is not None:
            self._start(str(self._rng.choice(SURROUNDINGS)))
        while not is_reached() and not self._ends_within(_LOOK_EVERY_S):
            pass
        return not self._ends_within(float(self._rng.uniform(0, longest_s)))

    def _start(self, surroundings: str) -> None:
        """Start it, in a part of the cases where it cannot keep a cache, write much, or say anything."""
        self.faults[surroundings] += 1
        environment, most_bytes = dict(self._environment), int(self._rng.integers(5_000, 60_000))
        if surroundings == "no home":
            del environment["XDG_CACHE_HOME"]
            environment["HOME"] = "/proc"
        with Path("/dev/full" if surroundings == "nobody listens" else os.devnull).open("wb") as output:
            self._process = subprocess.Popen(
                [*self._command, "--workers", "2"],
                stdout=output,
                stderr=output,
                env=environment,
                # A file that must not grow any more ends like one on a full disk.
                preexec_fn=(lambda: _limit_files(most_bytes)) if surroundings == "full disk" else None,
            )

    def harm(self) -> None:
        """Do something to a finished frame or a compiled loop, whether the run is at work or not."""
        kinds = HARMS if self._loops is None else (*HARMS, LOOP_HARM)
        kind, there = str(self._rng.choice(kinds)), layout.frame_indices(self._out)
        files = [] if self._loops is None else sorted(path for path in self._loops.rglob("*") if path.is_file())
        if kind == "none" or not (files if kind == LOOP_HARM else there):
            return
        self.faults[kind] += 1
        if kind == LOOP_HARM:
            with suppress(FileNotFoundError):
                self._damage(files[int(self._rng.integers(len(files)))])
            return
        folder = layout.frame_folder(self._out, int(self._rng.choice(there)))
        name = str(self._rng.choice([layout.RECORD_FILE, "left.png", "right_parts.png"]))
        with suppress(FileNotFoundError):
            if kind == "vanished frame":
                shutil.rmtree(folder)
            elif kind == "half a frame":
                (folder / name).unlink()
            else:
                self._damage(folder / name)

    def _damage(self, path: Path) -> None:
        """Cut a file off, or turn over one of its bits."""
        data = path.read_bytes()
        place = int(self._rng.integers(0, max(1, len(data))))
        is_cut = path.suffix not in (".nbi", ".nbc") or self._rng.integers(2) == 0
        path.write_bytes(data[:place] if is_cut else data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])

    def frames(self) -> int:
        """Number of finished frames."""
        return len(layout.frame_indices(self._out))

    def begins(self) -> int:
        """How often it has started."""
        events = self._out / layout.EVENTS_FILE
        return events.read_text().count('"event": "start"') if events.exists() else 0

    def kill(self) -> None:
        """Kill a random worker, the run, or the run and its workers."""
        assert self._process is not None
        run = self._process.pid
        children = Path(f"/proc/{run}/task/{run}/children").read_text().split()
        workers = [int(child) for child in children]
        victims = {"worker": [*self._rng.permutation(workers)][:1], "run": [run], "tree": [run, *workers]}
        chosen = str(self._rng.choice(list(victims)))
        for victim in victims[chosen]:
            with suppress(ProcessLookupError):
                os.kill(int(victim), signal.SIGKILL)
        self.kills += bool(victims[chosen])
        if chosen != "worker":
            self._process.wait()

    def end(self) -> None:
        """Kill what is left of it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _ends_within(self, seconds: float) -> bool:
        assert self._process is not None
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True


def _limit_files(most_bytes: int) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))


def torture(recipe_text: str, kills: int, folder: Path, loops: Path | None = None) -> None:
    """Kill a run so many times while it renders a recipe, and compare with an undisturbed one.

    Args:
        recipe_text: of what is rendered.
        kills: how many.
        folder: for all files.
        loops: folder of compiled loops, which are damaged too.
    """
    calm, out, recipe, scratch = folder / "calm", folder / "out", folder / "recipe.toml", folder / "scratch"
    recipe.write_text(recipe_text)
    scratch.mkdir()
    planned = render_recipe(calm, text=recipe_text).planned
    rng = np.random.Generator(np.random.Philox(8))
    run = KilledRun(recipe, out, scratch, rng, loops)
    try:
        while run.kills < kills:
            if kills - run.kills <= max(1, kills // 10):
                # The last ones meet it when all frames are there, and manifest and annotations are written.
                begun = run.begins()
                is_at_work = run.go_on_until(
                    lambda begun=begun: run.frames() == planned and run.begins() > begun, longest_s=0.01 * planned
                )
            else:
                # With the frames that end meanwhile some two thirds of all: kills meet frames to the last.
                more = int(rng.integers(0, round(planned / kills / 2) + 1))
                goal = min(planned, run.frames() + more)
                is_at_work = run.go_on_until(lambda goal=goal: run.frames() >= goal, 0.3 if more == 0 else 0.05)
            if is_at_work:
                run.harm()
                run.kill()
    finally:
        run.end()
    print(
        f"{run.kills} kills, {run.begins()} starts, {run.frames()} of {planned} pairs, {len(leftovers(out))} "
        f"leftovers; {dict(run.faults)}"
    )
    summary = render_recipe(out, text=recipe_text)
    assert summary.drops == ()
    assert leftovers(out) == []
    assert [*scratch.iterdir()] == []
    assert summary.dataset_sha256 == read_manifest(calm).dataset_sha256
    assert file_hashes(out) == file_hashes(calm)
    assert validate_dataset(out).passed


def test_kills_at_random_instants_change_nothing(tmp_path: Path) -> None:
    torture(ANALYTIC_RECIPE.replace("count = 8", "count = 12"), 2, tmp_path)


@pytest.mark.slow
@pytest.mark.torture
def test_fifty_kills_over_two_hundred_pairs_change_nothing(tmp_path: Path) -> None:
    torture(ANALYTIC_RECIPE.replace("count = 8", "count = 200"), 50, tmp_path, tmp_path / "loops")
