"""What tests of several packages share; recipes of small datasets are in `tests/support/small_datasets.py`."""

from __future__ import annotations

import importlib.util
import io
import os
import re
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.shared_folder import shared_folder

# The same draws on every machine, however busy it is; `make fuzz` draws anew.
settings.register_profile("suite", deadline=None, derandomize=True, database=None)
settings.load_profile("suite")

# Libraries read this when they load. The suite runs several processes at a time, and in small problems threads of each
# mostly wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A shell that starts the tests in the background has them ignore Ctrl-C, and every program that they start with them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_TORCH = r"torch|nav\.training|nav\.detector\.network|droguekit\.torch|tests\.support\.detector_networks"
IMPORTS_TORCH = re.compile(rf"^(import|from) ({_TORCH})\b", re.MULTILINE)


class TorchModule(pytest.Module):
    """A module of tests that cannot be imported where torch is missing."""

    def collect(self) -> Iterator[pytest.Item]:
        """Skip it all, with the reason."""
        pytest.skip("torch is missing: pip install 'droguekit[train]'", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
    """Skip the tests that import torch where it is missing."""
    if importlib.util.find_spec("torch") is None and IMPORTS_TORCH.search(module_path.read_text(encoding="utf-8")):
        return TorchModule.from_parent(parent, path=module_path)
    return None


RENDERED_FIXTURES = {"smoke_dataset", "tiny_dataset"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests on rendered datasets, and skip all that need Mitsuba where it is missing."""
    missing = importlib.util.find_spec("mitsuba") is None
    for item in items:
        if RENDERED_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.mitsuba)
        if missing and item.get_closest_marker("mitsuba") is not None:
            item.add_marker(pytest.mark.skip(reason="mitsuba is missing: pip install 'droguekit[mitsuba]'"))


@pytest.fixture
def full_disk() -> Callable[[int], AbstractContextManager[None]]:
    """Within `full_disk(most_bytes)` no file may grow beyond so many bytes, and the system says so as on a full disk.

    It holds for this process and those that it starts.
    """

    @contextmanager
    def limited(most_bytes: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


@pytest.fixture(scope="session")
def smoke_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped recipe `smoke`, rendered once by the real engine; to be read only (copy it to change it)."""
    from datasets_manifest.recipe.recipe import load_recipe
    from droguekit.batch.progress import PlainProgress
    from droguekit.batch.render_dataset import render_dataset

    def render(out: Path) -> None:
        source, told = load_recipe("smoke"), io.StringIO()
        summary = render_dataset(source, out, range(source.recipe.frames.count), 0, PlainProgress(told))
        assert summary.drops == (), told.getvalue()

    return shared_folder(tmp_path_factory, "smoke", render)
