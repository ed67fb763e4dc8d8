"""A folder and an object store behave alike through the same interface."""

from __future__ import annotations

import pickle
import re
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datasets_manifest.storage import layout
from datasets_manifest.storage.frame_store import FrameStore, list_frames, shard_numbers
from datasets_manifest.storage.manifest import build_manifest, read_manifest, write_manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import LocalStorage, absolute, as_location, join, map_in_order, open_storage
from datasets_manifest.storage.writer import (
    encode_files,
    encode_record,
    leftovers,
    remove_frame,
    remove_leftovers,
    write_frame,
)
from labelgen.export.frame_files import link_or_copy


@pytest.fixture(params=["folder", "memory"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """An empty place of each kind; the memory is that of this process."""
    return tmp_path / "place" if request.param == "folder" else f"memory://{uuid.uuid4().hex}"


def test_files_are_kept_replaced_and_removed(place: Path | str) -> None:
    storage = open_storage(place)
    assert not storage.root_exists() and not storage.exists("a") and storage.names("") == []
    storage.write("a", b"first")
    storage.write("a", b"0123456789")
    storage.write("folder/b.json", b"")
    assert storage.root_exists() and storage.exists("a") and storage.size("a") == 10
    assert storage.read("a") == b"0123456789" and storage.read("a", 3, 4) == b"3456" and storage.read("a", 8) == b"89"
    assert storage.names("") == ["a", "folder"] and storage.names("folder") == ["b.json"] and storage.names("no") == []
    assert storage.files_ending(".json") == ["folder/b.json"]
    with storage.open("a") as stream:
        stream.seek(5)
        assert stream.read(2) == b"56"
    storage.delete("a")
    storage.delete("a")
    assert storage.names("") == ["folder"]
    with pytest.raises(FileNotFoundError):
        storage.read("a")


def test_streams_count_when_their_block_ends_without_an_error(place: Path | str) -> None:
    storage = open_storage(place)
    storage.write("text", b"old")
    with pytest.raises(RuntimeError, match="stop"), storage.write_text("text") as stream:
        stream.write("new")
        raise RuntimeError("stop")
    assert storage.read("text") == b"old"
    with storage.write_text("text") as stream:
        stream.write("größer\n")
    with storage.write_large("deep/bytes") as stream:
        stream.write(bytes(100_000))
        stream.seek(0)
        assert len(stream.read()) == 100_000
    assert storage.read("text").decode() == "größer\n" and storage.size("deep/bytes") == 100_000
    with storage.spool("") as spool:
        spool.write("passes")
    assert storage.names("") == ["deep", "text"]


def test_a_folder_counts_with_its_last_file(place: Path | str) -> None:
    storage = open_storage(place)
    storage.write_together("frames/000001", {"x": b"1", "record.json": b"{}"}, "record.json")
    storage.write_together("frames/000002", {"x": b"2", "record.json": b"{}"}, "record.json")
    storage.write_together("frames/000002", {"x": b"3", "record.json": b"{}"}, "record.json")
    storage.write("frames/000003/x", b"half")
    assert storage.folders_with("frames", "record.json") == ["000001", "000002"]
    assert storage.read("frames/000002/x") == b"3"
    storage.delete_folder("frames/000001", "record.json")
    storage.delete_folder("frames/000001", "record.json")
    assert storage.folders_with("frames", "record.json") == ["000002"] and storage.names("frames/000001") == []


def test_objects_of_a_frame_without_its_record_are_leftovers(maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, _, _, _, add_frame = maker
    place = f"memory://{uuid.uuid4().hex}"
    add_frame(place, make_recipe(), 0)
    add_frame(place, make_recipe(), 1)
    # The record is the first to go and the last to come.
    open_storage(place).delete("frames/000001/record.json")
    names = ["left.png", "left_parts.png", "right.png", "right_parts.png"]
    assert leftovers(place) == [f"{place}/frames/000001/{name}" for name in names]
    assert FrameStore(place).indices() == [0]
    assert len(remove_leftovers(place)) == 4 and leftovers(place) == []
    remove_frame(place, 0)
    assert FrameStore(place).indices() == []


def test_what_other_people_keep_in_a_dataset_is_no_leftover(
    place: Path | str, maker: tuple[Callable[..., Any], ...]
) -> None:
    make_recipe, _, _, _, add_frame = maker
    add_frame(place, make_recipe(), 0)
    others = ["even/shards/000000.tar", "even/annotations/all.json", "bags/flight-0/x.mcap", "frames/notes.txt"]
    for name in others:
        open_storage(place).write(name, b"mine")
    assert leftovers(place) == remove_leftovers(place) == []
    assert all(open_storage(place).read(name) == b"mine" for name in others)


def test_what_a_caller_does_wrong_with_a_stream_stays_the_callers_error(place: Path | str) -> None:
    storage = open_storage(place)
    storage.write("a", bytes(range(256)) * 4)
    with pytest.raises(ValueError, match="mine"), storage.open("a"):
        raise ValueError("mine")
    with storage.open("a") as stream:
        assert stream.seek(-6, 2) == 1018 and stream.read() == bytes(range(250, 256)) and stream.read(1) == b""
        assert stream.seek(2) == 2 and stream.read(3) == b"\2\3\4" and stream.tell() == 5
    with pytest.raises(FileNotFoundError), storage.open("b") as stream:
        stream.read()


def test_a_dataset_reads_the_same_from_both(place: Path | str, maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, make_images, make_parts, make_record, _ = maker
    recipe = make_recipe()
    for index in (0, 2):
        write_frame(
            place, make_record(recipe, index), encode_files(make_images(recipe, index), make_parts(recipe, index))
        )
    write_manifest(place, build_manifest(place, recipe, "1", dict.fromkeys(range(recipe.frames.scenes), "train")))
    dataset = pickle.loads(pickle.dumps(Dataset(place)))  # data loaders send it to other processes
    assert dataset.frame_indices == (0, 2)
    assert (dataset.images(2).right == make_images(recipe, 2).right).all()
    assert (dataset.part_ids(2, "left") == make_parts(recipe, 2)["left"]).all()
    assert dataset.record(0).frame_index == 0 and dataset.verify(0) == dataset.verify(2) == []
    open_storage(place).write("frames/000002/left.png", b"changed")
    assert dataset.verify(2) == [f"{place}/frames/000002/left.png: was changed: its hash differs from the recorded one"]
    open_storage(place).delete("frames/000002/left.png")
    with pytest.raises(ValueError, match=r"frames/000002/left\.png: is missing"):
        dataset.images(2)


def test_a_frame_is_handed_on_as_it_is_on_record_or_not_at_all(
    place: Path | str, maker: tuple[Callable[..., Any], ...]
) -> None:
    make_recipe, make_images, make_parts, make_record, _ = maker
    recipe = make_recipe()
    files = encode_files(make_images(recipe, 0), make_parts(recipe, 0))
    record = write_frame(place, make_record(recipe, 0), files)
    write_manifest(place, build_manifest(place, recipe, "1", dict.fromkeys(range(recipe.frames.scenes), "train")))
    found, data = Dataset(place).whole_frame(0)
    assert (encode_record(found), data) == (encode_record(record), files)
    storage = open_storage(place)
    for name in ("right.png", "record.json"):
        whole = storage.read(f"frames/000000/{name}")
        storage.write(f"frames/000000/{name}", whole + b" ")
        with pytest.raises(
            ValueError, match=rf"frames/000000/{name}: was changed: its hash differs from the recorded one"
        ):
            Dataset(place).whole_frame(0)
        storage.write(f"frames/000000/{name}", whole)


def test_a_link_that_leads_to_itself_is_one_clear_line(tmp_path: Path, maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, _, _, _, add_frame = maker
    add_frame(tmp_path, make_recipe(), 0)
    image = tmp_path / "frames/000000/left.png"
    image.unlink()
    image.symlink_to("left.png")
    with pytest.raises(ValueError, match=r"left\.png: (cannot be read|leads outside)"):
        FrameStore(tmp_path).read(0, "left.png")


def test_places_by_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert as_location("s3://bucket/name/") == "s3://bucket/name"
    assert as_location("data/demo") == as_location("data/demo/") and join("s3://b/n", "x") == "s3://b/n/x"
    assert as_location(f"file://{tmp_path}") == tmp_path
    for nothing in ("s3://", "s3:///", "memory://", "file://"):
        with pytest.raises(ValueError, match=f"{nothing}: is incomplete; give {nothing.rstrip('/')}//NAME"):
            as_location(nothing)
    for empty in ("", "  "):
        with pytest.raises(ValueError, match=f"place: must be a folder or a URL, got '{empty}'"):
            as_location(empty)
    monkeypatch.chdir(tmp_path)
    assert absolute("data") == tmp_path / "data" and absolute("s3://b/n") == "s3://b/n"


def test_a_place_may_be_called_as_what_lies_in_it() -> None:
    storage = open_storage(f"memory://{uuid.uuid4().hex}/frames")
    storage.write_together("frames/000001[2]*", {"x": b"", "record.json": b"{}"}, "record.json")
    assert storage.names("") == ["frames"] and storage.names("frames") == ["000001[2]*"]
    storage.delete_folder("frames/000001[2]*", "record.json")
    assert storage.folders_with("frames", "record.json") == []


@pytest.mark.parametrize("url", ["nonsense://x/y", "s3:///"])
def test_urls_that_nobody_knows_are_refused(url: str) -> None:
    with pytest.raises((ValueError, OSError), match=url.split(":")[0]) as caught:
        read_manifest(url)
    assert "\n" not in str(caught.value)


def test_a_missing_package_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    # What Python does for a package that is not installed.
    monkeypatch.setitem(__import__("sys").modules, "fsspec.core", None)
    with pytest.raises(ValueError, match=r'missing: pip install "droguekit\[remote\]"'):
        open_storage(f"memory://{uuid.uuid4().hex}")


@pytest.mark.parametrize("place", ["folder", "memory"], indirect=True)
def test_work_comes_back_in_order_and_errors_in_their_turn(place: Path | str) -> None:
    storage = open_storage(place)
    assert list(map_in_order(lambda number: number**2, range(100), storage)) == [number**2 for number in range(100)]
    results = map_in_order(lambda number: 1 / (50 - number), range(100), storage)
    assert [next(results) for _ in range(50)] == [1 / (50 - number) for number in range(50)]
    with pytest.raises(ZeroDivisionError):
        next(results)


@pytest.mark.parametrize("url", ["reference://x", "foo://x", "zip://x::/no/such/file.zip"])
def test_urls_that_are_no_storage_are_named(url: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(url)}: cannot be used as storage: .+$"):
        open_storage(url)


@pytest.mark.parametrize(
    "name", ["\u0663", "\u0660" * 6, "7", "0000007", "1" * 5000, "-00001", "+00001", "00 001", "1e5"]
)
def test_stray_names_are_no_frames(name: str, tmp_path: Path) -> None:
    """Digits of other scripts, other spellings of a number, and numbers that are too long for Python."""
    assert layout.frame_of_name(name) is None
    assert layout.frame_of_name("000007") == 7 and layout.frame_of_name("1234567") == 1234567
    if len(name) > 255:
        return
    (tmp_path / "frames" / name).mkdir(parents=True)
    (tmp_path / "frames" / name / "record.json").touch()
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / f"{name}.tar").touch()
    assert list_frames(tmp_path) == layout.frame_indices(tmp_path) == shard_numbers(LocalStorage(tmp_path)) == []


def test_a_file_that_is_swapped_for_a_link_after_it_was_looked_at_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "dataset" / "frames" / "000000"
    folder.mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    (folder / "left.png").symlink_to(tmp_path / "secret")
    # What a look at the file said before somebody swapped it.
    monkeypatch.setattr(LocalStorage, "leads_outside", lambda *_: False)
    with pytest.raises(ValueError, match=r"left\.png: cannot be read: leads outside its folder"):
        FrameStore(tmp_path / "dataset").read(0, "left.png")
    with pytest.raises(ValueError, match=r"left\.png: leads outside its folder"):
        link_or_copy(folder / "left.png", tmp_path / "out" / "left.png")
    assert not (tmp_path / "out" / "left.png").is_symlink() and not (tmp_path / "out" / "left.png").exists()
