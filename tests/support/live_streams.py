"""Videos and streams of stereo pairs, as a camera would send them: files, and servers on sockets of this machine."""

from __future__ import annotations

import re
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

RATE_HZ = 25
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Codec:
    """How frames are encoded.

    Attributes:
        container: format's name.
        name: of the encoder.
        pixels: pixel format that it gets.
        options: of the encoder.
        container_options: of the format.
    """

    container: str
    name: str
    pixels: str
    options: Mapping[str, str] = field(default_factory=dict)
    container_options: Mapping[str, str] = field(default_factory=dict)


# Each frame leaves at once.
FFV1 = Codec("matroska", "ffv1", "bgr0", {}, {"live": "1", "cluster_time_limit": "0", "flush_packets": "1"})
FFV1_GREY = Codec("matroska", "ffv1", "gray", {}, FFV1.container_options)
FFV1_DEEP = Codec("matroska", "ffv1", "gray16le", {}, FFV1.container_options)
# Lossless, in R, G, B.
H264 = Codec("mpegts", "libx264rgb", "rgb24", {"qp": "0", "tune": "zerolatency", "preset": "ultrafast", "g": "4"})


def side_by_side(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    return [np.concatenate(views, axis=1) for views in pairs]


def encode(
    place: Any,
    images: Sequence[np.ndarray],
    codec: Codec = FFV1,
    times: Sequence[int] | None = None,
    sent: Callable[[int], object] = lambda index: None,
) -> None:
    """Write images of one size.

    Args:
        place: a file's name, or an object with `write`.
        images: (H, W, 3) red, green, blue or (H, W) grey.
        codec: by which they are encoded.
        times: of each image in frames of 25 Hz; one after the other when None.
        sent: called after each.
    """
    with av.open(place, "w", format=codec.container, options=dict(codec.container_options)) as container:
        stream: Any = container.add_stream(codec.name, rate=RATE_HZ, options=dict(codec.options))
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = codec.pixels
        for index, image in enumerate(images):
            kind = "rgb24" if image.ndim == 3 else "gray" if image.dtype == np.uint8 else "gray16le"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=kind)
            frame.pts, frame.time_base = index if times is None else times[index], Fraction(1, RATE_HZ)
            container.mux(stream.encode(frame))
            sent(index)
        container.mux(stream.encode(None))


class Wire:
    """A connected socket as a file."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def write(self, data: bytes) -> int:
        self._connection.sendall(data)
        return len(data)

    def receive(self) -> bytes:
        """What the client sends; nothing once it has gone."""
        return self._connection.recv(65536)

    def close(self) -> None:
        """Tell the client that nothing more comes."""
        self._connection.shutdown(socket.SHUT_WR)


@contextmanager
def serve(send: Callable[[Wire], None]) -> Iterator[str]:
    """A server for one client, to which `send` writes in a thread; yields its address."""
    faults: list[BaseException] = []

    def answer() -> None:
        try:
            connection, _ = listener.accept()
            with connection:
                send(Wire(connection))
        except (BrokenPipeError, ConnectionResetError):
            pass  # the client had enough
        except BaseException as fault:
            faults.append(fault)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)
        thread = threading.Thread(target=answer)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            thread.join(PATIENCE_S)
    assert not thread.is_alive() and faults == []


def write_calibration(path: Path, width: int, height: int, focal_px: float, baseline_m: float) -> Path:
    """An ideal rig's calibration, as OpenCV's samples write it."""
    intrinsics = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    values: dict[str, Any] = {"image_width": width, "image_height": height}
    values |= {"M1": intrinsics, "M2": intrinsics, "D1": np.zeros((1, 5)), "D2": np.zeros((1, 5))}
    values |= {"R": np.eye(3), "T": np.array([[-baseline_m], [0.0], [0.0]])}
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def h264_units(images: Sequence[np.ndarray], codec: Codec = H264) -> list[list[bytes]]:
    """The NAL units of each image."""
    encoder: Any = av.CodecContext.create(codec.name, "w")
    encoder.height, encoder.width = images[0].shape[:2]
    encoder.pix_fmt, encoder.time_base = codec.pixels, Fraction(1, RATE_HZ)
    encoder.options = dict(codec.options)
    units = []
    for index, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, frame.time_base = index, Fraction(1, RATE_HZ)
        data = b"".join(bytes(packet) for packet in encoder.encode(frame))
        units.append([unit for unit in re.split(b"\0{2,3}\1", data) if unit])
    assert encoder.encode(None) == []
    return units


def rtsp_camera(images: Sequence[np.ndarray]) -> Callable[[Wire], None]:
    """Answers as an RTSP server with one H.264 track, interleaved in its connection (RFC 2326, section 10.12)."""
    units = h264_units(images)

    def send(wire: Wire) -> None:
        playing = False
        while not playing:
            request = b""
            while not request.endswith(b"\r\n\r\n"):
                request += wire.receive()
            method = request.split()[0].decode()
            cseq = re.search(rb"CSeq: *(\d+)", request, re.IGNORECASE)
            assert cseq is not None
            head, body = {
                "OPTIONS": ("Public: OPTIONS, DESCRIBE, SETUP, PLAY", ""),
                "DESCRIBE": ("Content-Type: application/sdp", _SDP),
                "SETUP": ("Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 7", ""),
                "PLAY": ("Session: 7\r\nRange: npt=0.000-", ""),
            }[method]
            lines = ("RTSP/1.0 200 OK", f"CSeq: {cseq[1].decode()}", head, f"Content-Length: {len(body)}", "", body)
            wire.write("\r\n".join(lines).encode())
            playing = method == "PLAY"
        sequence, start = 0, 90_000  # libav takes a clock that starts at 0 for one that is not known
        for index, image_units in enumerate(units):
            pieces = [piece for unit in image_units for piece in _fragments(unit)]
            for place, piece in enumerate(pieces):
                marker = 0x80 if place == len(pieces) - 1 else 0
                header = struct.pack(">BBHII", 0x80, marker | 96, sequence, start + index * 90_000 // RATE_HZ, 1)
                wire.write(b"$\0" + struct.pack(">H", len(header) + len(piece)) + header + piece)
                sequence = (sequence + 1) % 65536

    return send


_SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=stereo\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\n"
    "a=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\na=control:track\r\n"
)


def _fragments(unit: bytes, most: int = 1400) -> list[bytes]:
    """A NAL unit as payloads of RTP, whole or in fragments FU-A (RFC 6184, section 5.8)."""
    if len(unit) <= most:
        return [unit]
    indicator, kind = (unit[0] & 0xE0) | 28, unit[0] & 0x1F
    parts = [unit[place : place + most] for place in range(1, len(unit), most)]
    flags = [(0x80 if index == 0 else 0) | (0x40 if index == len(parts) - 1 else 0) for index in range(len(parts))]
    return [bytes([indicator, flag | kind]) + part for flag, part in zip(flags, parts, strict=True)]
