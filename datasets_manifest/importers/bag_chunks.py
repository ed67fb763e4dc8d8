"""Checks the files of a ROS bag before its reader takes them: sizes, compressed chunks, texts, and checksums if any.

A megabyte of bzip2 can hold many gigabytes, a column of a database may be computed anew for each row, and flipped bits
of a picture look like a picture.
"""

from __future__ import annotations

import bz2
import sqlite3
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, BinaryIO, cast

import lz4.frame  # type: ignore[import-untyped]
import yaml

from drogue_models.untrusted_files import open_regular, read_text

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MOST_CHUNK_BYTES = 2**28
"""Most bytes of a chunk; recorders begin a new one after some megabytes, or after one message."""
MOST_EXPANSION = 100
"""A compressed file, or all its compressed chunks, may expand to the size of a chunk and so many times its own size."""
MOST_TOPIC_BYTES = 2**20
"""Most bytes that a file tells of its topics beside their names: how they were offered, in YAML."""
_CONTENTS_FILE = "metadata.yaml"
_BLOCK_BYTES = 2**20
_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_MCAP_MAGIC, _ROS1_MAGIC, _ZSTD_MAGIC = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"\x28\xb5\x2f\xfd"
_MCAP_FOOTER, _MCAP_CHANNEL, _MCAP_CHUNK, _MCAP_DATA_END, _ROS1_CHUNK = 0x02, 0x04, 0x06, 0x0F, 0x05
# A chunk holds schemas, channels and messages.
_MCAP_IN_CHUNKS = (0x03, _MCAP_CHANNEL, 0x05)
# Views and tables of programs, and columns that are computed, have contents of any size in a file of a few bytes.
_COMPUTED = """
select name from sqlite_master
where sql not like 'create table %' and sql not like 'create index %' and sql not like 'create unique index %'
union all
select tables.name from sqlite_master as tables, pragma_table_xinfo(tables.name) as columns where columns.hidden
"""


def check_bag(bag: Path) -> int:
    """Check a bag's files: their chunks, what a compressed one expands to, and the size of the table of contents.

    Returns:
        Size of all files. [bytes]

    Raises:
        ValueError: a chunk is too large or not as large as it says, or a checksum is wrong; names the file.
        OSError: a file cannot be read.
    """
    files = sorted(path for path in bag.iterdir() if path.is_file()) if bag.is_dir() else [bag]
    for path in files:
        if path.name == _CONTENTS_FILE:
            _check_contents(path)
            continue
        with open_regular(path) as stream:
            magic = stream.read(len(_ROS1_MAGIC))
            most_bytes = MOST_CHUNK_BYTES + MOST_EXPANSION * path.stat().st_size
            try:
                if magic == _ROS1_MAGIC:
                    _check_ros1(stream, most_bytes)
                elif magic.startswith(_MCAP_MAGIC):
                    stream.seek(0)
                    _check_mcap(stream, most_bytes)
                elif magic.startswith(_ZSTD_MAGIC):
                    stream.seek(0)
                    _check_compressed(stream, most_bytes)
            except (struct.error, EOFError, UnicodeDecodeError) as error:
                raise ValueError(f"{path}: is truncated or damaged") from error
            except ValueError as error:
                raise ValueError(f"{path}: is damaged: {error}") from error
    return sum(path.stat().st_size for path in files)


def check_database(path: Path) -> None:
    """Check the tables of a `.db3` file before its reader asks for them.

    Raises:
        ValueError: it is no database, computes contents, or tells too much of its topics.
    """
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
            if (computed := database.execute(_COMPUTED).fetchone()) is not None:
                raise ValueError(f"{computed[0]!r} is computed, and no table")
            columns = database.execute("select name from pragma_table_xinfo('topics')").fetchall()
            if ("offered_qos_profiles",) in columns:
                ((told_bytes,),) = database.execute("select total(length(offered_qos_profiles)) from topics")
                _check_told(told_bytes)
    except sqlite3.Error as error:
        raise ValueError(f"is no database of a recording: {error}") from error


def _check_contents(path: Path) -> None:
    """Refuse references in a table of contents, by which a line stands for any number of topics."""
    text = read_text(path)
    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text, Loader=_yaml_loader())):
            raise ValueError(f"{path}: refers to parts of itself (*name), which no recorder writes")
    except yaml.YAMLError:
        return  # its reader says what is wrong


def _yaml_loader() -> Any:
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _check_told(told_bytes: float) -> None:
    if told_bytes > MOST_TOPIC_BYTES:
        raise ValueError(f"tells {told_bytes:.0f} bytes of its topics, at most {MOST_TOPIC_BYTES} are read")


def _check_compressed(stream: BinaryIO, most_bytes: int) -> None:
    """Refuse a compressed file that would fill the disk, as the reader expands it there, or holds what is refused."""
    found, magic = 0, b""
    try:
        with zstd.open(stream, "rb") as expanded:
            while block := expanded.read(_BLOCK_BYTES):
                magic = magic or block[: len(_MCAP_MAGIC)]
                found += len(block)
                if found > most_bytes:
                    raise ValueError(f"expands to more than {most_bytes} bytes")
        if magic == _MCAP_MAGIC:
            stream.seek(0)
            with zstd.open(stream, "rb") as expanded:
                _check_mcap(cast(BinaryIO, expanded), most_bytes)
    except zstd.ZstdError as error:
        raise ValueError(f"cannot be decompressed: {error}") from error


def _check_mcap(stream: BinaryIO, most_bytes: int) -> None:
    """Source: the MCAP specification (mcap.dev/spec): records are an opcode, a length and contents."""
    place = len(_MCAP_MAGIC)
    data_crc = zlib.crc32(stream.read(place))
    chunks_bytes, summary_start = 0, 0
    channels = _Channels()
    while head := stream.read(9):
        opcode, length = struct.unpack("<BQ", head)
        place += len(head) + length
        if opcode == _MCAP_FOOTER:
            (stated,) = struct.unpack_from("<Q", stream.read(8))
            if stated not in (0, summary_start):
                raise ValueError("its summary is not where it says")
            return
        if opcode != _MCAP_DATA_END:
            data_crc = zlib.crc32(head, data_crc)
        if opcode not in (_MCAP_CHANNEL, _MCAP_CHUNK, _MCAP_DATA_END):
            for block in _blocks(stream, length):
                data_crc = zlib.crc32(block, data_crc)
            continue
        if length > MOST_CHUNK_BYTES:
            raise ValueError(f"has a chunk of {length} bytes, at most {MOST_CHUNK_BYTES} are read")
        data = _exactly(stream, length)
        if opcode == _MCAP_DATA_END:
            (expected,) = struct.unpack_from("<I", data)
            if expected not in (0, data_crc):
                raise ValueError("the checksum of its messages is wrong")
            summary_start = place
            continue
        data_crc = zlib.crc32(data, data_crc)
        if opcode == _MCAP_CHANNEL:
            channels.add(data)
            continue
        size, crc, name_length = struct.unpack_from("<QII", data, 16)
        name = data[32 : 32 + name_length].decode()
        contents = _decompressed(data[32 + name_length + 8 :], name, size)
        chunks_bytes += size
        _check_chunks(chunks_bytes, most_bytes)
        if crc not in (0, zlib.crc32(contents)):
            raise ValueError("the checksum of a chunk is wrong")
        start = 0
        while start + 9 <= len(contents):
            opcode, length = struct.unpack_from("<BQ", contents, start)
            if opcode not in _MCAP_IN_CHUNKS:
                raise ValueError(f"a chunk has a record of kind {opcode}, which belongs to none")
            start += 9 + length
            if opcode == _MCAP_CHANNEL:
                channels.add(contents[start - length : start])


class _Channels:
    """What the channels of an MCAP file say; its reader takes one record of each."""

    def __init__(self) -> None:
        self._bytes: dict[bytes, int] = {}
        self._total_bytes = 0

    def add(self, record: bytes) -> None:
        """Count a record."""
        before = self._bytes.get(record[:2], 0)
        if len(record) > before:
            self._bytes[record[:2]] = len(record)
            self._total_bytes += len(record) - before
            _check_told(self._total_bytes)


def _check_chunks(chunks_bytes: int, most_bytes: int) -> None:
    if chunks_bytes > most_bytes:
        raise ValueError(f"its chunks expand to more than {most_bytes} bytes")


def _check_ros1(stream: BinaryIO, most_bytes: int) -> None:
    """Source: wiki.ros.org/Bags/Format/2.0: records are a header of named fields, and data."""
    chunks_bytes = 0
    while head := stream.read(4):
        header = _exactly(stream, struct.unpack("<I", head)[0])
        fields, place = dict[bytes, bytes](), 0
        while place < len(header):
            (length,) = struct.unpack_from("<I", header, place)
            name, _, value = header[place + 4 : place + 4 + length].partition(b"=")
            fields[name] = value
            place += 4 + length
        (length,) = struct.unpack("<I", _exactly(stream, 4))
        if fields.get(b"op") != bytes([_ROS1_CHUNK]) or fields.get(b"compression") == b"none":
            for _ in _blocks(stream, length):
                pass
            continue
        (size,) = struct.unpack("<I", fields.get(b"size", b""))
        if length > MOST_CHUNK_BYTES:
            raise ValueError(f"has a chunk of {length} bytes, at most {MOST_CHUNK_BYTES} are read")
        _decompressed(_exactly(stream, length), fields.get(b"compression", b"").decode(), size)
        chunks_bytes += size
        _check_chunks(chunks_bytes, most_bytes)


def _decompressed(data: bytes, name: str, size: int) -> bytes:
    """The contents of a chunk; of an unknown compression as they are."""
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"has a chunk of {size} bytes, at most {MOST_CHUNK_BYTES} are read")
    if name not in _DECOMPRESSORS:
        return data
    found = b""
    while data and len(found) <= size:
        decompressor = _DECOMPRESSORS[name]()
        try:
            found += decompressor.decompress(data, max_length=size + 1 - len(found))
        except (OSError, RuntimeError, zstd.ZstdError) as error:
            raise ValueError(f"a chunk cannot be decompressed: {error}") from error
        if not decompressor.eof:
            break
        # Several streams may follow on each other.
        data = decompressor.unused_data or b""
    if len(found) != size:
        raise ValueError(f"a chunk does not have the {size} bytes that it states")
    return found


def _exactly(stream: BinaryIO, size: int) -> bytes:
    """The next bytes; memory is taken for those that are there."""
    data = b"".join(_blocks(stream, size))
    if len(data) != size:
        raise EOFError
    return data


def _blocks(stream: BinaryIO, size: int) -> Iterator[bytes]:
    while size > 0 and (block := stream.read(min(size, _BLOCK_BYTES))):
        size -= len(block)
        yield block
