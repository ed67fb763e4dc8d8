"""Arrays that are kept on disk: made once, made anew where code or file is not what it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from datasets_manifest import user_cache
from datasets_manifest.user_cache import kept_arrays, user_cache_folder

Made = Callable[[], dict[str, NDArray[np.generic]]]


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The code of some arrays, and a cache of this test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "paint.py"
    path.write_text("first")
    return path


def kept(source: Path, value: float) -> float:
    """The number of the kept arrays, which are made of `value`."""
    user_cache._digest.cache_clear()
    arrays = kept_arrays("land", [str(source)], lambda: {"a b": np.full((300, 400), value), "none": np.zeros((0, 2))})
    assert arrays["none"].shape == (0, 2)
    assert (arrays["a b"] == arrays["a b"][0, 0]).all()
    return float(arrays["a b"][0, 0])


def files() -> list[Path]:
    return sorted(user_cache_folder().rglob("*.*"))


def test_arrays_are_made_once(source: Path) -> None:
    assert [kept(source, 1.0), kept(source, 2.0)] == [1.0, 1.0]


def test_arrays_of_other_code_are_made_anew_and_replace_the_old(source: Path) -> None:
    kept(source, 1.0)
    first = files()
    # Left by a process that was killed as it wrote.
    (first[0].parent / f".{first[0].name}-0123.part").write_bytes(b"half")
    source.write_text("second")
    assert [kept(source, 2.0), kept(source, 3.0)] == [2.0, 2.0]
    assert len(files()) == 1
    assert files() != first


@pytest.mark.parametrize("damage", ["flipped bit", "truncated", "empty", "other"])
def test_damaged_files_are_made_anew(source: Path, damage: str) -> None:
    kept(source, 1.0)
    (path,) = files()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes({"flipped bit": data, "truncated": data[:-7000], "empty": b"", "other": b"\x93NUMPY\x01"}[damage])
    assert [kept(source, 2.0), kept(source, 3.0)] == [2.0, 2.0]


def test_no_changed_byte_ends_the_process_or_gives_other_numbers(source: Path) -> None:
    """Bytes that no checksum covers, such as times of members, may change nothing."""
    user_cache._digest.cache_clear()
    kept_arrays("land", [str(source)], lambda: {"a": np.arange(3.0)})
    (path,) = files()
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x48]) + whole[place + 1 :])
        arrays = kept_arrays("land", [str(source)], lambda: {"a": np.arange(3.0)})
        assert arrays["a"].tolist() == [0.0, 1.0, 2.0], place


def test_where_nothing_can_be_written_arrays_are_made_each_time(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    assert [kept(source, 1.0), kept(source, 2.0)] == [1.0, 2.0]
