"""Checks the files of a ROS bag before its reader takes them: sizes, compressed chunks, and checksums if any.

A megabyte of bzip2 can hold many gigabytes, and flipped bits of a picture look like a picture.
"""

from __future__ import annotations

import bz2
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame  # type: ignore[import-untyped]

from drogue_models.untrusted_files import open_regular, read_text

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MOST_CHUNK_BYTES = 2**28
"""Most bytes of a chunk; recorders begin a new one after some megabytes, or after one message."""
MOST_EXPANSION = 100
"""A file that is compressed as a whole may expand to the size of a chunk, and to so many times its own size."""
_CONTENTS_FILE = "metadata.yaml"
_BLOCK_BYTES = 2**20
_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_MCAP_MAGIC, _ROS1_MAGIC, _ZSTD_MAGIC = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"\x28\xb5\x2f\xfd"
_MCAP_CHUNK, _MCAP_DATA_END, _ROS1_CHUNK = 0x06, 0x0F, 0x05


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
            read_text(path)
            continue
        with open_regular(path) as stream:
            magic = stream.read(len(_ROS1_MAGIC))
            try:
                if magic == _ROS1_MAGIC:
                    _check_ros1(stream)
                elif magic.startswith(_MCAP_MAGIC):
                    stream.seek(0)
                    _check_mcap(stream)
                elif magic.startswith(_ZSTD_MAGIC):
                    stream.seek(0)
                    _check_expansion(stream, path.stat().st_size)
            except (struct.error, EOFError, UnicodeDecodeError) as error:
                raise ValueError(f"{path}: is truncated or damaged") from error
            except ValueError as error:
                raise ValueError(f"{path}: is damaged: {error}") from error
    return sum(path.stat().st_size for path in files)


def _check_expansion(stream: BinaryIO, file_bytes: int) -> None:
    """Refuse a compressed file that would fill the disk, as the reader expands it there."""
    most_bytes = MOST_CHUNK_BYTES + MOST_EXPANSION * file_bytes
    found = 0
    try:
        with zstd.open(stream, "rb") as expanded:
            while block := expanded.read(_BLOCK_BYTES):
                found += len(block)
                if found > most_bytes:
                    raise ValueError(f"expands to more than {most_bytes} bytes")
    except zstd.ZstdError as error:
        raise ValueError(f"cannot be decompressed: {error}") from error


def _check_mcap(stream: BinaryIO) -> None:
    """Source: the MCAP specification (mcap.dev/spec): records are an opcode, a length and contents."""
    data_crc = zlib.crc32(stream.read(len(_MCAP_MAGIC)))
    while head := stream.read(9):
        opcode, length = struct.unpack("<BQ", head)
        if opcode == _MCAP_DATA_END:
            (expected,) = struct.unpack_from("<I", stream.read(4))
            if expected not in (0, data_crc):
                raise ValueError("the checksum of its messages is wrong")
            return
        data_crc = zlib.crc32(head, data_crc)
        if opcode != _MCAP_CHUNK:
            for block in _blocks(stream, length):
                data_crc = zlib.crc32(block, data_crc)
            continue
        if length > MOST_CHUNK_BYTES:
            raise ValueError(f"has a chunk of {length} bytes, at most {MOST_CHUNK_BYTES} are read")
        data = _exactly(stream, length)
        data_crc = zlib.crc32(data, data_crc)
        size, crc, name_length = struct.unpack_from("<QII", data, 16)
        name = data[32 : 32 + name_length].decode()
        contents = _decompressed(data[32 + name_length + 8 :], name, size)
        if crc not in (0, zlib.crc32(contents)):
            raise ValueError("the checksum of a chunk is wrong")


def _check_ros1(stream: BinaryIO) -> None:
    """Source: wiki.ros.org/Bags/Format/2.0: records are a header of named fields, and data."""
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
