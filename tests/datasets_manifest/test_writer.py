from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.atomic import open_text_atomic, write_text_atomic
from datasets_manifest.storage.layout import frame_folder, frame_indices
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import encode_files, encode_record, leftovers, remove_leftovers, write_frame


def entries(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_frame_holds_its_files_and_their_hashes(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, _, _, _, add_frame = maker
    record = add_frame(tmp_path, make_recipe(), 123)
    folder = tmp_path / "frames" / "000123"
    assert entries(tmp_path / "frames" / "000123") == [
        "left.png",
        "left_parts.png",
        "record.json",
        "right.png",
        "right_parts.png",
    ]
    for name, digest in record.file_sha256.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert set(record.file_sha256) == {"left.png", "left_parts.png", "right.png", "right_parts.png"}
    assert (folder / "record.json").read_bytes() == encode_record(record)
    assert frame_indices(tmp_path) == [123] and leftovers(tmp_path) == []


def test_records_come_back_bit_for_bit(tiny: Path, maker: tuple[Callable[..., Any], ...]) -> None:
    _, _, _, make_record, _ = maker
    dataset = Dataset(tiny)
    for index in dataset.frame_indices:
        data = (frame_folder(tiny, index) / "record.json").read_bytes()
        record = dataset.record(index)
        assert encode_record(record) == data
        wanted = make_record(dataset.manifest.recipe, index, empty=index == 3)
        assert encode_record(wanted.model_copy(update={"file_sha256": record.file_sha256})) == data


def test_record_schema(tiny: Path) -> None:
    table = json.loads((frame_folder(tiny, 0) / "record.json").read_text())
    assert np.array(table["left_from_drogue"]).shape == (4, 4)
    assert table["left_from_drogue"][3] == [0.0, 0.0, 0.0, 1.0]
    assert {"markers", "hub", "box_full_xywh_px", "box_visible_xywh_px"} <= set(table["views"]["left"])
    assert list(table) == sorted(table)
    # The shortest decimal that reads back the same.
    assert table["pitch_deg"] == 1 / 3 and "0.3333333333333333" in (frame_folder(tiny, 0) / "record.json").read_text()


def test_bytes_depend_on_nothing_else(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, make_images, make_parts, make_record, _ = maker
    recipe = make_recipe()
    files = encode_files(make_images(recipe, 2), make_parts(recipe, 2))
    turned = dict(reversed(files.items()))
    for folder, contents in (("a", files), ("b", turned)):
        write_frame(tmp_path / folder, make_record(recipe, 2), contents)
    for name in [*files, "record.json"]:
        one, other = (frame_folder(tmp_path / folder, 2) / name for folder in ("a", "b"))
        assert one.read_bytes() == other.read_bytes()


def test_writing_again_replaces(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, _, _, make_record, add_frame = maker
    recipe = make_recipe()
    add_frame(tmp_path, recipe, 5)
    write_frame(tmp_path, make_record(recipe, 5), {"note.txt": b"new"})
    assert entries(frame_folder(tmp_path, 5)) == ["note.txt", "record.json"]
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("name", ["../evil.png", "a/b.png", "record.json", "", "..", "a\\b", "c:x"])
def test_names_that_are_not_plain_are_refused(maker: tuple[Callable[..., Any], ...], tmp_path: Path, name: str) -> None:
    make_recipe, _, _, make_record, _ = maker
    with pytest.raises(ValueError, match="files: must have plain names"):
        write_frame(tmp_path / "dataset", make_record(make_recipe(), 0), {name: b""})
    assert not (tmp_path / "dataset").exists()


def test_part_ids_of_another_size_are_refused(maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, make_images, make_parts, _, _ = maker
    recipe = make_recipe()
    parts = make_parts(recipe, 0)
    parts["right"] = parts["right"][1:]
    with pytest.raises(ValueError, match=r"part_ids\['right'\]: must be \(36, 48\)"):
        encode_files(make_images(recipe, 0), parts)


def run_apart(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run code that may import this folder's conftest in a process of its own; `{folder!r}` in it is the argument."""
    here = Path(__file__).parent
    roots = os.pathsep.join([str(here), str(here.parents[1])])
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code).format(folder=str(folder))],
        env={**os.environ, "PYTHONPATH": roots},
        capture_output=True,
        text=True,
        check=False,
    )


REFUSED = """
import resource
from pathlib import Path
from conftest import add_frame, make_recipe
# The kernel refuses to let any file grow beyond this; every picture does.
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
try:
    add_frame(Path({folder!r}), make_recipe(), 1)
except OSError as error:
    print(error)
"""


def test_a_write_that_fails_leaves_nothing(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, _, _, _, add_frame = maker
    add_frame(tmp_path / "dataset", make_recipe(), 0)
    before = entries(tmp_path)
    said = run_apart(REFUSED, tmp_path / "dataset").stdout.splitlines()
    assert len(said) == 1 and said[0].endswith("frames/000001: cannot be written: File too large")
    assert entries(tmp_path) == before


def test_a_full_disk_leaves_nothing_half_written(small_disk: Path, maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, _, _, _, add_frame = maker
    recipe, dataset = make_recipe(), small_disk / "dataset"
    written = 0
    with pytest.raises(OSError, match="cannot be written: No space left on device") as caught:
        for index in range(100):
            add_frame(dataset, recipe, index)
            written += 1
    assert "\n" not in str(caught.value) and f"{written:06d}" in str(caught.value)
    assert written >= 1
    assert frame_indices(dataset) == list(range(written))
    assert [entry.name for entry in (dataset / "frames").iterdir()] != []
    assert leftovers(dataset) == []
    with pytest.raises(OSError, match=r"manifest\.json: cannot be written: No space left"):
        write_text_atomic(dataset / "manifest.json", "x" * 100_000)
    assert not (dataset / "manifest.json").exists() and leftovers(dataset) == []


def test_a_folder_that_cannot_be_made_is_one_clear_line(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, _, _, _, add_frame = maker
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot be written: Not a directory") as caught:
        add_frame(tmp_path / "file", make_recipe(), 0)
    assert "\n" not in str(caught.value)


UNWRITABLE = """
import os
from pathlib import Path
from conftest import add_frame, make_recipe
recipe = make_recipe()
# Nothing is unwritable for root.
if os.geteuid() == 0:
    os.setuid(65534)
try:
    add_frame(Path({folder!r}), recipe, 0)
except PermissionError as error:
    print(error)
"""


def test_an_unwritable_folder_is_one_clear_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    said = run_apart(UNWRITABLE, tmp_path / "dataset").stdout.splitlines()
    tmp_path.chmod(0o700)
    assert len(said) == 1 and said[0].endswith("frames/000000: cannot be written: Permission denied")
    assert entries(tmp_path) == []


KILLED = """
import os, signal
from pathlib import Path

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

# The process is killed at the moment when everything is written but the rename.
Path.rename = die
from conftest import add_frame, make_recipe
add_frame(Path({folder!r}), make_recipe(), 7)
"""


def test_a_killed_run_leaves_only_leftovers(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, _, _, _, add_frame = maker
    done = run_apart(KILLED, tmp_path / "dataset")
    assert done.returncode == -signal.SIGKILL
    dataset = tmp_path / "dataset"
    assert frame_indices(dataset) == []
    left = Path(*leftovers(dataset))
    assert left.parent == dataset / "frames" and left.name.startswith(".000007-")
    (dataset / "annotations").mkdir()
    (dataset / "annotations" / ".all.json-1.part").write_text("{")
    assert len(remove_leftovers(dataset)) == 2 and leftovers(dataset) == []
    add_frame(dataset, make_recipe(), 7)
    assert frame_indices(dataset) == [7]
    assert remove_leftovers(tmp_path / "none") == []


def test_text_is_replaced_at_the_end_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "note.txt"
    write_text_atomic(path, "first\n")
    with pytest.raises(RuntimeError, match="stop"), open_text_atomic(path) as stream:
        stream.write("second")
        raise RuntimeError("stop")
    assert path.read_bytes() == b"first\n" and entries(tmp_path / "new") == ["note.txt"]
    write_text_atomic(path, "größer")
    assert path.read_text(encoding="utf-8") == "größer"
    write_text_atomic(tmp_path / "plain.txt", "")
    (tmp_path / "usual.txt").write_text("")
    # Everybody whom the umask lets in may read it, as any file.
    assert (tmp_path / "plain.txt").stat().st_mode == (tmp_path / "usual.txt").stat().st_mode
