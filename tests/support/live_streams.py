"""Videos and streams of stereo pairs, as a camera would send them: files, and servers on sockets of this machine."""

from __future__ import annotations

import socket
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
