"""Recordings of ROS, of at most a megabyte a file, that would fill memory or disk or take hours."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin

from datasets_manifest.importers.bag_chunks import zstd
from tests.support.ros_messages import stereo, write_bag2

MOST_BYTES = 10**6
_MIB, _GIB = 2**20, 2**30


def _zeros_zstd(size: int) -> bytes:
    return zstd.compress(bytes(16 * _MIB)) * (size // (16 * _MIB))


def _bag(change: Callable[[Path, Path], None], plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Callable[[Path], Path]:
    """Writes a recording whose folder and file of messages are changed."""

    def write(folder: Path) -> Path:
        bag = write_bag2(folder / "bag", stereo((1.0, 2.0)), plugin)
        (messages,) = (path for path in bag.iterdir() if path.suffix in (".db3", ".mcap"))
        change(bag, messages)
        return bag

    return write


def _compress_file(bag: Path, messages: Path) -> None:
    messages.with_suffix(".db3.zstd").write_bytes(_zeros_zstd(3 * _GIB))
    messages.unlink()
    _state_compression(bag, "FILE", messages.name)


def _state_compression(bag: Path, mode: str, name: str = "") -> None:
    text = (bag / "metadata.yaml").read_text()
    stated = text.replace("compression_format: ''", "compression_format: zstd")
    stated = stated.replace("compression_mode: ''", f"compression_mode: {mode}")
    (bag / "metadata.yaml").write_text(stated.replace(name, f"{name}.zstd") if name else stated)
    assert stated != text


def _compress_messages(bag: Path, messages: Path) -> None:
    _state_compression(bag, "MESSAGE")
    with sqlite3.connect(messages) as database:
        database.execute("update messages set data = ?", (_zeros_zstd(3 * _GIB),))


def _generate_messages(bag: Path, messages: Path) -> None:
    with sqlite3.connect(messages) as database:
        database.execute("drop table messages")
        columns = "id integer primary key, topic_id integer, timestamp integer"
        database.execute(f"create table messages({columns}, data blob as (zeroblob(900000000)))")
        database.executemany("insert into messages(topic_id, timestamp) values (?, 1)", [(k,) for k in range(1, 5)])


def _widen_contents(bag: Path, messages: Path) -> None:
    (bag / "metadata.yaml").write_text("[" + "[]," * 30_000 + "]")


def _define_messages(bag: Path, messages: Path) -> None:
    with sqlite3.connect(messages) as database:
        database.execute("update message_definitions set encoded_message_definition = ?", ("\n" * 200_000 + "!",))


def _offer_topics(bag: Path, messages: Path) -> None:
    """A chunk in which a channel is offered in a hundred megabytes of YAML."""
    told = b"[" + b"[]," * (30 * _MIB) + b"]"
    texts = (b"/a", b"cdr", struct.pack("<I", 20) + b"offered_qos_profiles" + struct.pack("<I", len(told)) + told)
    channel = bytes(4) + b"".join(struct.pack("<I", len(text)) + text for text in texts)
    _add_chunks(messages, b"\x04" + struct.pack("<Q", len(channel)) + channel, 1)


def _fill_chunks(bag: Path, messages: Path) -> None:
    """Chunks of messages that expand to many gigabytes."""
    message = bytes(200 * _MIB)
    _add_chunks(messages, b"\x05" + struct.pack("<Q", len(message)) + message, 100)


def _add_chunks(messages: Path, contents: bytes, count: int) -> None:
    packed = zstd.compress(contents)
    chunk = struct.pack("<QQQII", 0, 2**62, len(contents), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    record = b"\x06" + struct.pack("<Q", len(chunk)) + chunk
    # Without a summary, so that its reader looks at all chunks.
    data = messages.read_bytes()
    (summary_start,) = struct.unpack_from("<Q", data, len(data) - 28)
    body = data[: summary_start - 13] + record * min(count, (MOST_BYTES - summary_start) // len(record))
    messages.write_bytes(body + b"\x0f" + struct.pack("<QI", 4, 0) + data[-37:-28] + bytes(20) + data[-8:])


def _refer_to_topics(bag: Path, messages: Path) -> None:
    head = (bag / "metadata.yaml").read_text().split("  topics_with_message_count:\n")[0]
    topic = "{message_count: 0, topic_metadata: {name: a, type: b, serialization_format: cdr, "
    topic += f"offered_qos_profiles: '[{'[],' * 3000}]'}}}}"
    topics = f"  topics_with_message_count: [&a {topic}{', *a' * 200_000}]\n"
    (bag / "metadata.yaml").write_text(f"{head}{topics}")


def _ros1_chunks() -> bytes:
    """Chunks that expand to many gigabytes, of a compression that is slow."""
    contents = bytes(200 * _MIB)
    packed = bz2.compress(contents)
    fields = [b"op=\x05", b"compression=bz2", b"size=" + struct.pack("<I", len(contents))]
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    chunk = struct.pack("<I", len(head)) + head + struct.pack("<I", len(packed)) + packed
    return b"#ROSBAG V2.0\n" + chunk * ((MOST_BYTES - 13) // len(chunk))


def _hide_chunk(bag: Path, messages: Path) -> None:
    """A chunk within a record of an unknown kind, which only the index of the file leads to."""
    packed, size = _zeros_zstd(3 * _GIB), 3 * _GIB
    footer, body = (data := messages.read_bytes())[-37:], data[:-37]
    name = struct.pack("<I", 4) + b"zstd"
    chunk = struct.pack("<QQQI", 0, 2**62, size, 0) + name + struct.pack("<Q", len(packed)) + packed
    chunk = b"\x06" + struct.pack("<Q", len(chunk)) + chunk
    start = len(body) + 9
    body += b"\x80" + struct.pack("<Q", len(chunk)) + chunk
    index = struct.pack("<QQQQI", 0, 2**62, start, len(chunk), 0) + struct.pack("<Q", 0) + name
    index += struct.pack("<QQ", len(packed), size)
    summary = len(body)
    body += b"\x08" + struct.pack("<Q", len(index)) + index + data[struct.unpack("<Q", footer[9:17])[0] : -37]
    messages.write_bytes(body + footer[:9] + struct.pack("<QQI", summary, 0, 0) + footer[29:])


def _write_ros1(folder: Path) -> Path:
    path = folder / "a.bag"
    path.write_bytes(_ros1_chunks())
    return path


BAGS: dict[str, Callable[[Path], Path]] = {
    "bag file": _bag(_compress_file),
    "bag messages": _bag(_compress_messages),
    "bag columns": _bag(_generate_messages),
    "bag contents": _bag(_widen_contents),
    "bag definitions": _bag(_define_messages),
    "bag references": _bag(_refer_to_topics),
    "bag profiles": _bag(_offer_topics, StoragePlugin.MCAP),
    "bag chunks": _bag(_fill_chunks, StoragePlugin.MCAP),
    "bag of ros 1": _write_ros1,
    "bag hidden chunk": _bag(_hide_chunk, StoragePlugin.MCAP),
}
"""By name: writes a recording into a folder."""
