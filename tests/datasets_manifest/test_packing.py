"""Frames in tar files: the same dataset, by anybody's reader, and none lost at whatever instant a run is killed."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import tarfile
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import webdataset

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.frame_store import FrameStore, list_frames
from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import build_manifest, read_manifest, write_manifest
from datasets_manifest.storage.packing import Packing, configure_packing, pack_all, pack_if_complete, repair_shards
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import open_storage
from datasets_manifest.storage.writer import leftovers, remove_frame, remove_leftovers

FRAMES = (0, 1, 2, 3, 4, 6)


@pytest.fixture
def staged(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> Path:
    """Six frames in folders of their own, which are to come into tar files of three, and the manifest."""
    make_recipe, _, _, _, add_frame = maker
    recipe, dataset = make_recipe(), tmp_path / "dataset"
    for index in FRAMES:
        add_frame(dataset, recipe, index)
    configure_packing(dataset, 3)
    write_manifest(dataset, build_manifest(dataset, recipe, "1", dict.fromkeys(range(recipe.frames.scenes), "train")))
    return dataset


def contents(dataset: Path | str) -> dict[tuple[int, str], bytes]:
    """Every file of every frame."""
    store = FrameStore(dataset)
    return {(index, name): store.read(index, name) for index in store.indices() for name in store.names(index)}


def shards(dataset: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((dataset / "shards").iterdir())}


def test_packing_changes_where_frames_lie_and_nothing_else(staged: Path) -> None:
    before, manifest = contents(staged), read_manifest(staged)
    seen = [Dataset(staged).images(index).left for index in FRAMES]
    pack_all(staged)
    assert list((staged / "frames").iterdir()) == []
    assert list_frames(staged) == list(FRAMES) and contents(staged) == before
    dataset = Dataset(staged)
    again = build_manifest(staged, manifest.recipe, "1", dict.fromkeys(range(manifest.recipe.frames.scenes), "train"))
    assert again.dataset_sha256 == manifest.dataset_sha256
    for index, left in zip(FRAMES, seen, strict=True):
        assert dataset.verify(index) == []
        assert (dataset.images(index).left == left).all()
        assert (BlindDataset(staged).pair(index).images.left == left).all()
    assert dataset.frames.where(4, "left.png") == str(staged / "shards/000001.tar/000004.left.png")


def test_the_list_says_where_bytes_lie_and_what_they_hash_to(staged: Path) -> None:
    pack_all(staged)
    for number, frames in ((0, [0, 1, 2]), (1, [3, 4]), (2, [6])):
        data = (staged / f"shards/{number:06d}.tar").read_bytes()
        listed = FrameStore(staged)._shard(number)
        assert (listed.size, listed.sha256) == (len(data), hashlib.sha256(data).hexdigest())
        assert sorted(listed.frames) == frames
        with tarfile.open(staged / f"shards/{number:06d}.tar") as archive:
            members = archive.getmembers()
        assert [member.name for member in members] == sorted(member.name for member in members)
        assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) for m in members} == {(0, 0, 0, "", "", 0o644)}
        for member in members:
            key, _, name = member.name.partition(".")
            file = listed.frames[int(key)][name]
            assert (file.offset, file.size) == (member.offset_data, member.size)
            assert file.sha256 == hashlib.sha256(data[file.offset : file.end]).hexdigest()


def test_the_webdataset_package_reads_the_tar_files(staged: Path) -> None:
    wanted = contents(staged)
    pack_all(staged)
    samples = list(webdataset.WebDataset(str(staged / "shards/000000.tar"), shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == ["000000", "000001", "000002"]
    for index, sample in enumerate(samples):
        assert sample["left.png"] == wanted[index, "left.png"]
        assert sample["record.json"] == wanted[index, "record.json"]


def test_tar_files_depend_on_their_frames_alone(staged: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(staged, other)
    pack_all(staged)
    packing = Packing(3, range(7))
    for index in (6, 4, 2, 0, 1):  # in whatever order they become complete
        pack_if_complete(other, index, packing)
    assert sorted(path.name for path in (other / "shards").glob("*.tar")) == ["000000.tar", "000002.tar"]
    pack_all(other)
    assert shards(other) == shards(staged)


def test_a_tar_file_is_complete_with_the_frames_that_are_made(staged: Path) -> None:
    packing = Packing(3, range(0, 7, 2))
    assert [packing.members(number) for number in range(3)] == [{0, 2}, {4}, {6}]
    pack_if_complete(staged, 4, packing)
    assert sorted(FrameStore(staged).staged) == [0, 1, 2, 3, 6]
    assert list_frames(staged) == list(FRAMES)


def test_a_frame_that_is_made_again_replaces_the_packed_one(
    staged: Path, maker: tuple[Callable[..., Any], ...]
) -> None:
    before = contents(staged)
    pack_all(staged)
    whole = shards(staged)
    tar = staged / "shards/000000.tar"
    place = FrameStore(staged)._shard(0).frames[1]["left.png"].offset + 100
    data = bytearray(tar.read_bytes())
    data[place] ^= 1
    tar.write_bytes(data)
    assert Dataset(staged).verify(1) == [f"{tar}/000001.left.png: was changed: its hash differs from the recorded one"]
    make_recipe, _, _, _, add_frame = maker
    add_frame(staged, make_recipe(), 1)
    assert contents(staged) == before
    pack_all(staged)
    assert shards(staged) == whole and list((staged / "frames").iterdir()) == []


def test_a_damaged_folder_is_not_packed(staged: Path) -> None:
    (frame_folder(staged, 1) / "left.png").write_bytes(b"")
    pack_if_complete(staged, 1, Packing(3, range(7)))
    assert not (staged / "shards/000000.tar").exists()
    pack_all(staged)
    assert sorted(FrameStore(staged).staged) == [1] and list_frames(staged) == list(FRAMES)


def _die_at(step: int) -> None:
    """Let this process be killed before its `step`-th change of the disk."""
    count = 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def change(*arguments: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count == step:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **options)

        return change

    for name in ("rename", "replace", "unlink", "open"):
        setattr(Path, name, counted(getattr(Path, name)))
    shutil.rmtree = counted(shutil.rmtree)


def _packs_until_killed(dataset: Path, step: int) -> bool:
    """Pack in a process of its own; whether it was killed."""
    child = os.fork()
    if child == 0:
        try:
            _die_at(step)
            pack_if_complete(dataset, 2, Packing(3, range(7)))
            pack_all(dataset)
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def test_a_kill_at_any_change_of_the_disk_loses_no_frame(staged: Path, tmp_path: Path) -> None:
    wanted, calm = contents(staged), tmp_path / "calm"
    shutil.copytree(staged, calm)
    pack_all(calm)
    step, kills = 1, 0
    while True:
        out = tmp_path / "killed"
        shutil.copytree(staged, out)
        was_killed = _packs_until_killed(out, step)
        remove_leftovers(out)
        repair_shards(out)
        assert contents(out) == wanted
        pack_all(out)
        assert shards(out) == shards(calm) and leftovers(out) == [] and list((out / "frames").iterdir()) == []
        shutil.rmtree(out)
        if not was_killed:
            break
        step, kills = step + 1, kills + 1
    # Three archives and three lists, each opened, renamed and synced, and six folders that go in two steps.
    assert kills > 20


def test_the_size_of_tar_files_stays(staged: Path) -> None:
    configure_packing(staged, None)
    configure_packing(staged, 3)
    with pytest.raises(ValueError, match=r"--tar: .* has tar files of 3 pairs, got 4; leave it out"):
        configure_packing(staged, 4)
    with pytest.raises(ValueError, match="--tar: must be from 1 to 100000 pairs, got 0"):
        configure_packing(staged, 0)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: text[:-20], r"000000\.json: "),
        (lambda text: text.replace('"0":{', '"0":{"../x":[0,1,"' + "0" * 64 + '"],'), "plain file names"),
        (lambda text: text.replace('"record.json":[', '"record.json":[9999999999'), "beyond the end of the tar file"),
        (lambda text: text.replace('"size":', '"size":1'), "but that has"),
    ],
)
def test_a_spoilt_list_is_one_clear_line(staged: Path, spoil: Callable[..., Any], message: str) -> None:
    pack_all(staged)
    path = staged / "shards/000000.json"
    path.write_text(spoil(path.read_text()))
    with pytest.raises(ValueError, match=message) as caught:
        Dataset(staged).images(0)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert (Dataset(staged).images(3).left == Dataset(staged).images(3).left).all()


@pytest.fixture(params=["folder", "memory"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """A place of each kind where frames come into tar files of two."""
    place = tmp_path / "place" if request.param == "folder" else f"memory://{uuid.uuid4().hex}"
    configure_packing(place, 2)
    return place


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: b"no archive" * 100, "is not a complete tar file: "),
        (lambda data: data[: len(data) // 2], "is not a complete tar file: "),
        (lambda data: data.replace(b"000000.record.json", b"000000.rec0rd.json"), ""),
        (lambda data: data.replace(b"000000.", b"xxxxxx."), ""),
    ],
)
def test_an_archive_that_is_none_is_named(
    place: Path, maker: tuple[Callable[..., Any], ...], spoil: Callable[..., Any], message: str
) -> None:
    make_recipe, _, _, _, add_frame = maker
    add_frame(place, make_recipe(), 0)
    pack_all(place)
    storage = open_storage(place)
    storage.delete("shards/000000.json")
    storage.write("shards/000000.tar", spoil(storage.read("shards/000000.tar")))
    with pytest.raises(ValueError, match=rf"000000\.tar: {message}.*; delete it") as caught:
        repair_shards(place)
    assert "\n" not in str(caught.value)


def test_archives_of_a_store_are_packed_listed_and_mended_as_on_disk(
    place: Path | str, maker: tuple[Callable[..., Any], ...]
) -> None:
    make_recipe, _, _, _, add_frame = maker
    for index in range(3):
        add_frame(place, make_recipe(), index)
    before = contents(place)
    pack_if_complete(place, 1, Packing(2, range(4)))
    pack_all(place)
    storage = open_storage(place)
    assert FrameStore(place).staged == frozenset() and contents(place) == before
    lists = [storage.read(f"shards/{name}") for name in storage.names("shards")]
    storage.delete("shards/000000.json")
    repair_shards(place)
    assert [storage.read(f"shards/{name}") for name in storage.names("shards")] == lists
    # A folder that a killed run has left beside the archive, one made since, and a damaged one.
    for index in (0, 2, 3):
        add_frame(place, make_recipe(), index)
    storage.write("frames/000000/left.png", b"")
    before |= {(3, name): FrameStore(place).read(3, name) for name in FrameStore(place).names(3)}
    pack_all(place)
    assert FrameStore(place).staged == {0}
    remove_frame(place, 0)
    assert contents(place) == before


def test_a_list_is_made_again_from_its_archive(staged: Path) -> None:
    pack_all(staged)
    before = shards(staged)
    (staged / "shards/000000.json").unlink()
    with pytest.raises(ValueError, match=r"000000\.json: is missing; render the recipe again to repair it"):
        list_frames(staged)
    repair_shards(staged)
    assert shards(staged) == before


def test_threads_read_one_store_while_lists_come_and_go(staged: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = contents(staged)
    pack_all(staged)
    monkeypatch.setattr("datasets_manifest.storage.frame_store._MAX_CACHED_INDICES", 1)
    store = FrameStore(staged)
    places = [*wanted] * 20
    with ThreadPoolExecutor(16) as threads:
        assert [*threads.map(lambda place: store.read(*place), places)] == [wanted[place] for place in places]
    assert len(store._shards) == 1


def test_reads_stay_within_the_list(staged: Path) -> None:
    pack_all(staged)
    store = FrameStore(staged)
    for name in ("../layout.json", "none.png"):
        with pytest.raises(ValueError, match=r"leads outside|is missing"):
            store.read(0, name)
    with pytest.raises(ValueError, match=r"000005\.left\.png: is missing"):
        store.read(5, "left.png")
