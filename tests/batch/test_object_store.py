"""A real S3 protocol server on loopback as the place of datasets: complete and identical, whatever happens."""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from moto.backends import get_backend
from moto.core import DEFAULT_ACCOUNT_ID
from moto.server import ThreadedMotoServer
from s3fs import S3FileSystem

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage import layout
from datasets_manifest.storage.frame_store import FrameStore, list_frames
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import open_storage
from datasets_manifest.storage.writer import encode_record, leftovers
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.render_dataset import render_dataset
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.batch_datasets import ANALYTIC_RECIPE, file_hashes, render_recipe

BUCKET = "pairs"
# What moto takes for credentials; any others would do.
ENVIRONMENT = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def server() -> Iterator[ThreadedMotoServer]:
    """A server with one bucket, for this process and those that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logging.getLogger("werkzeug"), "level", logging.ERROR)
        server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        host, port = server.get_host_and_port()
        for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
            patch.setenv(name, value)
        open_storage(f"s3://{BUCKET}")._fs.mkdir(BUCKET)  # type: ignore[attr-defined]
        yield server
        server.stop()


@pytest.fixture
def place(server: ThreadedMotoServer, request: pytest.FixtureRequest) -> str:
    """A place of the test's own."""
    return f"s3://{BUCKET}/{request.node.name}"


@pytest.fixture(scope="module")
def text() -> str:
    """A recipe of five small pairs."""
    return ANALYTIC_RECIPE.replace("count = 8", "count = 5")


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory, text: str) -> Path:
    """What one undisturbed run makes on this machine's disk, a folder a frame."""
    out = tmp_path_factory.mktemp("local") / "dataset"
    render_recipe(out, workers=0, text=text)
    return out


@pytest.fixture(scope="module")
def local_tars(tmp_path_factory: pytest.TempPathFactory, text: str) -> Path:
    """The same in tar files of two pairs."""
    out = tmp_path_factory.mktemp("local-tars") / "dataset"
    render_recipe(out, workers=ExecutionOptions(0, pairs_per_tar=2), text=text)
    return out


def contents(dataset: Path | str) -> dict[str, bytes]:
    """All files that a dataset is made of; frames by their index, however they lie."""
    storage, store = open_storage(dataset), FrameStore(dataset)
    others = {*storage.files_ending(".json"), *storage.files_ending(".yaml"), layout.RECIPE_FILE, layout.CARD_FILE}
    # How the frames lie is told by these.
    telling = (layout.FRAMES_FOLDER, layout.SHARDS_FOLDER, layout.CROISSANT_FILE)
    files = {name: storage.read(name) for name in others if not name.startswith(telling)}
    frames = {f"{i}/{name}": store.read(i, name) for i in store.indices() for name in store.names(i)}
    return {**files, **frames}


@pytest.mark.parametrize("pairs_per_tar", [None, 2])
def test_a_run_makes_the_dataset_that_it_would_make_on_disk(
    place: str, pairs_per_tar: int | None, text: str, local: Path, local_tars: Path
) -> None:
    spread = ExecutionOptions(0, pairs_per_tar=pairs_per_tar)
    first = render_recipe(place, range(1, 4), spread, text)
    assert (first.kept, first.pairs) == (0, 3)
    # A frame half written, one that lacks a file, and one with another picture.
    storage = open_storage(place)
    storage.write("frames/000004/left.png", b"half")
    if pairs_per_tar is None:
        storage.delete("frames/000001/right.png")
        storage.write("frames/000002/left.png", storage.read("frames/000003/left.png"))
    summary = render_recipe(place, workers=0, text=text)
    assert (summary.kept, len(summary.totals.made)) == ((1, 4) if pairs_per_tar is None else (3, 2))
    assert summary.dataset_sha256 == read_manifest(local).dataset_sha256
    assert contents(place) == contents(local)
    assert leftovers(place) == []
    tars = storage.files_ending(".tar")
    assert tars == ([] if pairs_per_tar is None else [f"shards/00000{number}.tar" for number in range(3)])
    there = open_storage(local if pairs_per_tar is None else local_tars)
    for name in (layout.CROISSANT_FILE, *tars, *(f"shards/{name}" for name in there.names(layout.SHARDS_FOLDER))):
        assert storage.read(name) == there.read(name), name
    assert (storage.names("frames") == []) == (pairs_per_tar is not None)
    events = [json.loads(line)["event"] for line in storage.read(layout.EVENTS_FILE).splitlines()]
    assert events.count("start") == events.count("end") == 2 and events.count("frame") == 3 + len(summary.totals.made)


@pytest.fixture(scope="module")
def packed(server: ThreadedMotoServer, text: str) -> str:
    """A dataset in tar files on the object store; to be read only."""
    place = f"s3://{BUCKET}/packed"
    render_recipe(place, workers=ExecutionOptions(0, pairs_per_tar=2), text=text)
    return place


@pytest.mark.slow
def test_commands_read_it_there(packed: str, local: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, dataset in enumerate((str(local), packed)):
        out = tmp_path / str(number)
        assert run(["validate", dataset]) == DONE
        assert run(["navigate", dataset, "--method", "paper", "--out", str(out / "estimates.jsonl")]) == DONE
        scores = ["--estimates", str(tmp_path / "0" / "estimates.jsonl"), "--json", str(out / "benchmark.json")]
        assert run(["benchmark", dataset, *scores, "--html", str(out / "report.html")]) == DONE
        for name in ("kitti", "webdataset"):
            assert run(["export", dataset, "--format", name, "--out", str(out / name)]) == DONE
    told = capsys.readouterr().out
    assert f"{packed}: 5 pairs, no faults" in told and "tar files                                 3        0" in told
    one, other = file_hashes(tmp_path / "0"), file_hashes(tmp_path / "1")
    one.pop("estimates.jsonl"), other.pop("estimates.jsonl")  # hold times
    assert one == other
    assert len(one) > 20


def test_images_and_records_are_those_on_disk(packed: str, local: Path) -> None:
    here, there = Dataset(local), Dataset(packed)
    assert there.frame_indices == here.frame_indices
    for index in here.frame_indices:
        assert encode_record(there.record(index)) == encode_record(here.record(index))
        assert (there.images(index).right == here.images(index).right).all()
        assert (there.part_ids(index, "left") == here.part_ids(index, "left")).all()


# Keys that a store can hold and that no run of ours writes, below a dataset.
HOSTILE_KEYS = [
    "frames/../../../../etc/passwd", "frames/../record.json", "frames//record.json", "frames/./record.json",
    "frames/000009/../../manifest.json", "frames/a/../../../other/manifest.json", "annotations/../../evil.json",
    "frames/000001\x1b[2J/record.json", "frames/a\nb/x.png", "x\r\n.json", ".hidden.json", "frames/-00001/record.json",
    "frames/\u0660\u0660\u0660\u0660\u0660\u0669/record.json", "frames/999999999999999999999/record.json",
    "shards/\u0663.tar", "shards/000000.tar/x",
]  # fmt: skip


@pytest.mark.parametrize("stray", [0, pytest.param(2500, marks=pytest.mark.slow)])
def test_a_hostile_listing_changes_nothing(
    stray: int, place: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sha256 = render_recipe(place, range(3), 0, text).dataset_sha256
    backend = get_backend("s3")[DEFAULT_ACCOUNT_ID]["aws"]
    root = place.removeprefix(f"s3://{BUCKET}/")
    for key in (*HOSTILE_KEYS, *(f"frames/{number:030d}/record.json" for number in range(stray))):
        backend.put_object(BUCKET, f"{root}/{key}", b"{}")
    for key in ("frames/000004/left.png", "../other/manifest.json"):
        backend.put_object(BUCKET, f"{root}/{key}".replace(f"{root}/../", ""), b"half")
    before = {*backend.buckets[BUCKET].keys}
    assert list_frames(place) == [0, 1, 2]
    assert validate_dataset(place).faults == [f"{place}/frames/000004/left.png: was left by a run that was killed"]
    assert render_recipe(place, range(3), 0, text).dataset_sha256 == sha256
    # What a killed run leaves is removed, and nothing else.
    assert before - {*backend.buckets[BUCKET].keys} == {f"{root}/frames/000004/left.png"}
    out = tmp_path / "out"
    assert run(["validate", place]) == DONE
    assert run(["export", place, "--format", "webdataset", "--out", str(out / "webdataset")]) == DONE
    told = capsys.readouterr()
    assert "".join(each for each in told.out + told.err if not each.isprintable()).strip("\n") == ""
    assert [*tmp_path.iterdir()] == [out]


@pytest.mark.slow
def test_a_changed_tar_file_is_found(text: str, place: str) -> None:
    render_recipe(place, range(2), ExecutionOptions(0, pairs_per_tar=2), text)
    storage = open_storage(place)
    file = FrameStore(place)._shard(0).frames[1]["left_parts.png"]
    data = bytearray(storage.read("shards/000000.tar"))
    data[file.offset + 60] ^= 1
    storage.write("shards/000000.tar", bytes(data))
    faults = validate_dataset(place).faults
    assert f"{place}/shards/000000.json: is not the list of {place}/shards/000000.tar, which was changed" in faults
    assert (
        f"{place}/shards/000000.tar/000001.left_parts.png: was changed: its hash differs from the recorded one"
        in faults
    )
    assert run(["validate", place]) == FAULT
    assert render_recipe(place, range(2), 0, text).totals.made == [1]
    assert validate_dataset(place).passed


@pytest.mark.slow
def test_shards_are_merged_from_there_and_to_there(local: Path, place: str, text: str, tmp_path: Path) -> None:
    render_recipe(f"{place}/even", range(0, 5, 2), ExecutionOptions(0, pairs_per_tar=4), text)
    render_recipe(tmp_path / "odd", range(1, 5, 2), 0, text)
    assert list_frames(f"{place}/even") == [0, 2, 4]
    # Complete within the run: neighbours of a part come together in one file.
    assert open_storage(f"{place}/even").names("frames") == []
    assert run(["merge", f"{place}/whole", f"{place}/even", str(tmp_path / "odd"), "--tar", "3"]) == DONE
    assert contents(f"{place}/whole") == contents(local)


@pytest.mark.slow
def test_a_run_that_is_killed_with_all_its_processes_goes_on(
    place: str, text: str, local: Path, tmp_path: Path
) -> None:
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(text)
    options = ["--out", place, "--workers", "1", "--tar", "2"]
    command = [sys.executable, "-m", "droguekit.cli.main", "render", str(recipe), *options]
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary)}
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=environment) as process:
        storage = open_storage(place)
        while not (storage.names(layout.SHARDS_FOLDER)[1:] or storage.folders_with("frames", layout.RECORD_FILE)):
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.02)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for victim in (process.pid, *map(int, children)):
            os.kill(victim, signal.SIGKILL)
    assert [*temporary.iterdir()] == []
    summary = render_recipe(place, workers=0, text=text)
    assert summary.kept + len(summary.totals.made) == 5 and summary.kept >= 1
    assert contents(place) == contents(local)
    assert leftovers(place) == []


class Trouble:
    """What s3fs makes of a store that answers some requests with an error, after all its attempts."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._call = S3FileSystem._call_s3
        self._refused = lambda method, key: False
        patch.setattr(
            S3FileSystem, "_call_s3", lambda system, *words, **options: self._answer(system, *words, **options)
        )

    def refuse(self, refused: Callable[[str, str], bool]) -> None:
        """Let requests fail by their method and object."""
        self._refused = refused

    async def _answer(self, system: S3FileSystem, method: str, *words: Any, **options: Any) -> Any:
        if self._refused(method, options.get("Key", "")):
            raise OSError(errno.EBUSY, "Please reduce your request rate.")
        return await self._call(system, method, *words, **options)


def test_a_store_that_does_not_answer_has_not_said_that_anything_is_missing(
    place: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    render_recipe(place, range(2), 0, text)
    storage = open_storage(place)
    before = {name: storage.read(name) for name in storage.files_ending("") if name != layout.EVENTS_FILE}
    trouble = Trouble(monkeypatch)
    for refused in (
        lambda method, key: method == "head_object" and key.endswith(layout.MANIFEST_FILE),
        lambda method, key: method == "get_object" and key.endswith("000001/left.png"),
        lambda method, key: method == "get_object" and key.endswith("000001/record.json"),
    ):
        trouble.refuse(refused)
        with pytest.raises(OSError, match=f"{place}/.*: cannot be read: .*reduce your request rate"):
            render_recipe(place, range(2), 0, text)
    trouble.refuse(lambda method, key: method == "head_object")
    with pytest.raises(OSError, match="reduce your request rate"):
        storage.root_exists()
    trouble.refuse(lambda method, key: False)
    assert {name: storage.read(name) for name in before} == before
    assert (summary := render_recipe(place, range(2), 0, text)).kept == 2 and not summary.totals.made


@pytest.mark.slow
def test_a_large_object_is_sent_in_parts(place: str) -> None:
    storage = open_storage(place)
    # s3fs sends less than 100 MiB, twice the size of a part, in one request.
    block = bytes(range(256)) * 2**12
    with storage.write_large("large") as stream:
        for _ in range(101):
            stream.write(block)
    assert storage.size("large") == 101 * len(block)
    with storage.open("large") as stream:
        assert all(stream.read(len(block)) == block for _ in range(101)) and stream.read() == b""


@pytest.mark.slow
def test_dask_workers_write_there_themselves(place: str, text: str, local: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is missing: pip install 'droguekit[cluster]'")
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
    with distributed.LocalCluster(processes=True, **options) as cluster:
        spread = ExecutionOptions(0, scheduler=cluster.scheduler_address, pairs_per_tar=2)
        assert render_recipe(place, workers=spread, text=text).drops == ()
    assert contents(place) == contents(local)
    assert leftovers(place) == [] and open_storage(place).names(layout.FRAMES_FOLDER) == []


class Ends:
    """A progress report that stops the server once two frames are finished."""

    def __init__(self, server: ThreadedMotoServer) -> None:
        self._server, self._left = server, 2

    def begin(self, what: str, total: int) -> None:
        """Nothing to do."""

    def advance(self) -> None:
        self._left -= 1
        if self._left == 0:
            self._server.stop()

    def note(self, text: str) -> None:
        """Nothing to do."""

    def say(self, text: str) -> None:
        """Nothing to do."""

    def end(self) -> None:
        """Nothing to do."""


def test_a_lost_connection_ends_the_run_in_one_line_and_finished_frames_stay(
    server: ThreadedMotoServer, place: str, text: str, local: Path
) -> None:
    host, port = server.get_host_and_port()
    with pytest.raises(OSError, match=f"{place}/.*cannot be ") as caught:
        render_dataset(RecipeSource(parse_recipe(text), text), place, range(5), ExecutionOptions(0), Ends(server))
    assert "\n" not in str(caught.value)
    ThreadedMotoServer.__init__(server, ip_address=host, port=port, verbose=False)
    server.start()  # its contents belong to the process
    summary = render_recipe(place, workers=0, text=text)
    assert summary.kept == 2
    assert contents(place) == contents(local)


def test_places_that_cannot_be_used_are_one_clear_line(
    server: ThreadedMotoServer, local: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, message in (
        (["validate", "s3://nowhere/x"], "s3://nowhere/x: there is no such dataset"),
        (["validate", f"s3://{BUCKET}/nothing"], f"s3://{BUCKET}/nothing: there is no such dataset"),
        (["render", "smoke", "--out", "s3://nowhere/x"], "cannot be written: The specified bucket does not exist"),
        (["render", "smoke", "--out", "memory://x"], "is the memory of one process; give --workers 0"),
        (["render", "smoke", "--out", f"s3://{BUCKET}/none", "--tar", "0"], "--tar: must be from 1 to 100000 pairs"),
        (["merge", f"s3://{BUCKET}/none", str(local), "--tar", "100001"], "--tar: must be from 1 to 100000 pairs"),
        (["validate", "s3:///"], "s3:///: is incomplete; give s3://NAME"),
        (["merge", f"s3://{BUCKET}/none", "memory://"], "memory://: is incomplete; give memory://NAME"),
        (
            ["navigate", str(local), "--out", "s3://b/x"],
            "--out: must be a folder or file of this machine, got s3://b/x",
        ),
        (["export", str(local), "--format", "coco", "--out", "s3://b/x"], "--out: must be a folder or file of this"),
        (["import", "x", "--out", "s3://b/x"], "--out: must be a folder or file of this machine, got s3://b/x"),
        (["benchmark", str(local), "--json", "s3://b/x"], "--json: must be a folder or file of this machine"),
        (["benchmark", str(local), "--html", "s3://b/x"], "--html: must be a folder or file of this machine"),
        (["plan", "smoke", "--html", "s3://b/x"], "--html: must be a folder or file of this machine"),
        (["report", "--corpus", str(local), "--pdf", "s3://b/x"], "--pdf: must be a folder or file of this machine"),
        (["train", "smoke", "--out", "s3://b/x"], "--out: must be a folder or file of this machine, got s3://b/x"),
        (["render", "smoke", "--out", "s4://b/x"], "s4://b/x: cannot be used as storage: Protocol not known: s4"),
    ):
        assert run([*words, *(["--engine", "analytic"] if words[0] == "render" else [])]) == WRONG_INPUT
        told = capsys.readouterr().err
        assert message in told and told.count("\n") == 1
    assert not open_storage(f"s3://{BUCKET}/none").root_exists()
