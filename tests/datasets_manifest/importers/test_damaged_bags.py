"""Bags with flipped bits, and such as would fill memory or disk: one line each, before their reader takes them."""

from __future__ import annotations

import bz2
import io
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
from rosbags.rosbag2 import StoragePlugin

from datasets_manifest.importers import bag_chunks
from datasets_manifest.importers.bag_chunks import check_bag, zstd
from datasets_manifest.importers.ros_bag import RosBag
from drogue_models import untrusted_files
from tests.support.ros_messages import (
    HUMBLE,
    IMAGE,
    NOETIC,
    stereo,
    write_bag1,
    write_bag2,
)


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("is_chunked", [True, False])
def test_a_flipped_bit_in_an_image_is_named(compression: str, is_chunked: bool, tmp_path: Path) -> None:
    """In a file with checksums, as the writer of the MCAP project makes it; flipped bits look like noise."""
    writing = pytest.importorskip("mcap.writer")
    stream, images = io.BytesIO(), [bytes([value]) * 3000 for value in (7, 200)]
    options = {"compression": writing.CompressionType[compression], "use_chunking": is_chunked}
    writer = writing.Writer(stream, enable_crcs=True, enable_data_crcs=True, **options)
    writer.start("ros2")
    channel = writer.register_channel("/left/image_raw", "cdr", writer.register_schema(IMAGE, "ros2msg", b""))
    for place, data in enumerate(images):
        writer.add_message(channel, log_time=place, data=data, publish_time=place)
    writer.finish()
    path, data = tmp_path / "flight.mcap", stream.getvalue()
    path.write_bytes(data)
    check_bag(path)
    place = data.index(images[0]) + 1500 if compression == "NONE" or not is_chunked else 8 + len(data) // 4
    path.write_bytes(flipped(data, place))
    with pytest.raises(ValueError, match=r"flight\.mcap: is (damaged: |truncated or damaged)"):
        check_bag(path)


def chunk_of_mcap(compression: bytes, size: int, body: bytes) -> bytes:
    record = struct.pack("<QQQII", 0, 1, size, 0, len(compression)) + compression + struct.pack("<Q", len(body)) + body
    return b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(record)) + record


def chunk_of_ros1(compression: bytes, size: int, body: bytes) -> bytes:
    fields = [b"op=\x05", b"compression=" + compression, b"size=" + struct.pack("<I", size)]
    header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    return b"#ROSBAG V2.0\n" + struct.pack("<I", len(header)) + header + struct.pack("<I", len(body)) + body


ZEROS = bytes(2**24)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (chunk_of_mcap(b"lz4", 2**60, b""), "at most 268435456 are read"),
        (chunk_of_mcap(b"lz4", 100, lz4.frame.compress(ZEROS)), "does not have the 100 bytes that it states"),
        (chunk_of_mcap(b"zstd", 100, zstd.compress(ZEROS)), "does not have the 100 bytes that it states"),
        (chunk_of_mcap(b"zstd", 2**24, zstd.compress(ZEROS)[:-4]), "does not have|cannot be decompressed"),
        (chunk_of_mcap(b"lz4", 2**24, b"junk" * 99), "cannot be decompressed"),
        (chunk_of_ros1(b"bz2", 100, bz2.compress(ZEROS)), "does not have the 100 bytes that it states"),
        (chunk_of_ros1(b"bz2", 2**32 - 1, bz2.compress(ZEROS)), "at most 268435456 are read"),
        (chunk_of_ros1(b"lz4", 100, lz4.frame.compress(ZEROS)), "does not have the 100 bytes that it states"),
        (b"#ROSBAG V2.0\n" + struct.pack("<I", 2**32 - 1) + b"short", "truncated or damaged"),
        (b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, 2**63), "at most 268435456 are read"),
    ],
)
def test_chunks_that_would_fill_the_memory_are_refused(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / ("bomb.bag" if data.startswith(b"#") else "bomb.mcap")
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"^{path}: is .*({message})"):
        RosBag(path)


def packed_bag(folder: Path, mode: str) -> tuple[Path, Path]:
    """A recording that says to be compressed with zstd, and its file of messages."""
    bag = write_bag2(folder / "flight", stereo((1.0, 2.0)), StoragePlugin.SQLITE3)
    text = (bag / "metadata.yaml").read_text().replace("compression_format: ''", "compression_format: zstd")
    (bag / "metadata.yaml").write_text(text.replace("compression_mode: ''", f"compression_mode: {mode}"))
    return bag, bag / "flight.db3"


def test_a_file_that_would_fill_the_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag, messages = packed_bag(tmp_path, "FILE")
    (bag / "metadata.yaml").write_text((bag / "metadata.yaml").read_text().replace(".db3", ".db3.zstd"))
    packed = bag / "flight.db3.zstd"
    packed.write_bytes(zstd.compress(messages.read_bytes()))
    messages.unlink()
    assert RosBag(bag).count == 2
    monkeypatch.setattr(bag_chunks, "MOST_CHUNK_BYTES", 2**20)
    packed.write_bytes(packed.read_bytes() + zstd.compress(ZEROS))
    with pytest.raises(ValueError, match=r"flight\.db3\.zstd: is damaged: expands to more than \d+ bytes"):
        RosBag(bag)


def test_a_message_that_would_fill_the_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(untrusted_files, "MOST_MEMORY_BYTES", 2**27)
    bag, messages = packed_bag(tmp_path, "MESSAGE")
    bomb = zstd.compress(ZEROS) * 20
    with sqlite3.connect(messages) as database:
        database.execute("update messages set data = ?", (bomb,))
    with pytest.raises(ValueError, match=r"flight: is damaged: .*takes more than .* bytes of memory"):
        RosBag(bag)


def mcap_record(opcode: int, data: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(data)) + data


def mcap_text(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def mcap_channel(number: int, told: bytes) -> bytes:
    metadata = mcap_text(mcap_text(b"offered_qos_profiles") + mcap_text(told))
    return mcap_record(4, struct.pack("<HH", number, 0) + mcap_text(b"/a") + mcap_text(b"cdr") + metadata)


def test_what_channels_tell_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_chunks, "MOST_TOPIC_BYTES", 1000)
    path = tmp_path / "flight.mcap"
    # What is repeated in each chunk counts once.
    chunk = mcap_channel(1, b"x" * 400) + mcap_channel(2, b"x" * 400)
    packed = chunk_of_mcap(b"zstd", len(chunk), zstd.compress(chunk))
    path.write_bytes(packed + packed[8:])
    check_bag(path)
    path.write_bytes(packed + mcap_channel(3, b"x" * 400))
    with pytest.raises(ValueError, match=r"tells \d+ bytes of its topics, at most 1000 are read"):
        check_bag(path)


def test_chunks_hold_nothing_else_and_expand_to_a_bounded_total(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, message = tmp_path / "flight.mcap", mcap_record(5, bytes(10_000))
    packed = chunk_of_mcap(b"zstd", len(message), zstd.compress(message))
    monkeypatch.setattr(bag_chunks, "MOST_CHUNK_BYTES", len(message))
    monkeypatch.setattr(bag_chunks, "MOST_EXPANSION", 0)
    path.write_bytes(packed)
    check_bag(path)
    path.write_bytes(packed + packed[8:])
    with pytest.raises(ValueError, match="its chunks expand to more than 10009 bytes"):
        check_bag(path)
    zeros = bytes(9000)
    path.write_bytes(chunk_of_mcap(b"zstd", len(zeros), zstd.compress(zeros)))
    with pytest.raises(ValueError, match="record of kind 0, which belongs to none"):
        check_bag(path)


def test_a_summary_elsewhere_is_refused(tmp_path: Path) -> None:
    (path,) = write_bag2(tmp_path / "flight", stereo((1.0,))).glob("*.mcap")
    data = path.read_bytes()
    start = len(data) - 37 + 9
    path.write_bytes(data[:start] + struct.pack("<Q", struct.unpack_from("<Q", data, start)[0] - 1) + data[start + 8 :])
    with pytest.raises(ValueError, match="its summary is not where it says"):
        check_bag(path)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("alter table topics add column c as (hex(id))", "'topics' is computed, and no table"),
        ("create view v as select 1", "'v' is computed, and no table"),
        ("update topics set offered_qos_profiles = hex(zeroblob(600000))", "of its topics, at most 1048576 are read"),
    ],
)
def test_tables_that_compute_or_tell_too_much_are_refused(change: str, fault: str, tmp_path: Path) -> None:
    bag = write_bag2(tmp_path / "flight", stereo((1.0,)), StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(bag / "flight.db3")) as database, database:
        database.execute(change)
    with pytest.raises(ValueError, match=f"^{bag}: cannot be read as a ROS bag: .*{fault}$"):
        RosBag(bag)


DEFINITIONS = {
    "hostile": "\n" * 180_000 + "!",
    "another": "std_msgs/Header header\nuint32 width\nuint32 height\n",
    "as ROS has it": HUMBLE.generate_msgdef(IMAGE, ros_version=2)[0].replace(
        "uint32 width", "# columns\nuint32  width"
    ),
}


@pytest.mark.parametrize("name", DEFINITIONS)
def test_definitions_are_compared_and_not_parsed(name: str, tmp_path: Path) -> None:
    """A library's parser takes time with the square of the empty lines."""
    bag = write_bag2(tmp_path / "flight", stereo((1.0,)), StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(bag / "flight.db3")) as database, database:
        change = "update message_definitions set encoded_message_definition = ? where topic_type = ?"
        database.execute(change, (DEFINITIONS[name], IMAGE))
        # That of a message that is not read does not matter.
        database.execute("insert into message_definitions values (99, 'a/msg/B', 'ros2msg', ?, '')", ("!" * 99,))
    if name == "as ROS has it":
        assert RosBag(bag).count == 1
        return
    with pytest.raises(ValueError, match=f"ROS bag: /left/image_raw: its definition of {IMAGE} is not that of ROS$"):
        RosBag(bag)


def test_a_hash_of_another_definition_is_refused(tmp_path: Path) -> None:
    path = write_bag1(tmp_path / "flight.bag", (1.0,))
    digest = NOETIC.generate_msgdef(IMAGE)[1].encode()
    path.write_bytes(path.read_bytes().replace(digest, digest[::-1]))
    with pytest.raises(ValueError, match=f"/left/image_raw: its definition of {IMAGE} is not that of ROS$"):
        RosBag(path)


def test_a_table_of_contents_that_refers_to_itself_is_refused(tmp_path: Path) -> None:
    bag = write_bag2(tmp_path / "flight", stereo((1.0,)))
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(f"all: &a [1, 2]\nagain: *a\n{text}")
    with pytest.raises(ValueError, match=r"metadata\.yaml: refers to parts of itself \(\*name\)"):
        RosBag(bag)


def test_a_long_table_of_contents_is_refused(tmp_path: Path) -> None:
    bag = write_bag2(tmp_path / "flight", stereo((1.0,)))
    (bag / "metadata.yaml").write_text("# " + "x" * 2**20)
    with pytest.raises(ValueError, match="flight: cannot be read as a ROS bag: has more than 1048576 bytes"):
        RosBag(bag)
