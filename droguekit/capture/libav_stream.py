"""Images of devices, network streams and video files, through PyAV.

One library reads them all, because it tells what OpenCV's `VideoCapture` hides: the time stamp of each image, whether
it was damaged on the way, and what its numbers are. Colours in R, G, B, and grey, arrive as they were sent.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast
from urllib.parse import urlsplit

import cv2
import numpy as np

from datasets_manifest.importers.ros_images import BAYER_TO_RGB
from datasets_manifest.types.images import Pixels
from droguekit.capture.stereo_source import DAMAGED, UNSTAMPED, CapturedImage, LoadedImage
from nav.realtime import Clock

if TYPE_CHECKING:
    from av import Packet, VideoFrame
    from av.container import InputContainer

# AVFMT_NOTIMESTAMPS: the format has none, and the library invents them from a guessed rate.
_HAS_NO_STAMPS = 0x80
# AVCOL_SPC_BT709, _UNSPECIFIED, _FCC, _BT470BG, _SMPTE170M, _SMPTE240M, _BT2020_NCL: matrices of Y, Cb, Cr as ITU-T
# H.273 numbers them, and swscale's number of each.
_BT709, _BT601 = 1, 5
_MATRICES = {1: _BT709, 2: _BT601, 4: 4, 5: _BT601, 6: _BT601, 7: 7, 9: 9}
# AVCOL_RANGE_MPEG, _JPEG.
_LIMITED, _FULL = 1, 2
# SWS_BILINEAR, _ACCURATE_RND and _FULL_CHR_H_INT; without the latter two, numbers are off by up to two.
_CONVERSION = 0x2 | 0x40000 | 0x2000
_DEEP = (
    *("gray10le", "gray12le", "gray14le", "gray16le", "gray16be"),
    *("gbrp10le", "gbrp12le", "gbrp14le", "gbrp16le", "rgb48le", "rgb48be", "bgr48le"),
)
# Errors in a row by which a stream is given up.
_MOST_ERRORS = 100


@dataclass(frozen=True, eq=False)
class LibavPlace:
    """What to open.

    Attributes:
        name: for messages.
        url: device, file or address.
        format: name of libav's input format, or None to find out.
        options: of the format.
        timeout_s: longest wait for data; None for files and devices, which know none. [s]
        is_file: whether it was recorded, and ends without a fault.
    """

    name: str
    url: str
    format: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    timeout_s: float | None = None
    is_file: bool = False


class LibavStream:
    """See `ImageStream`."""

    def __init__(self, place: LibavPlace, view: int | None, clock: Clock) -> None:
        """Prepare to read.

        Args:
            place: what to open.
            view: see `CapturedImage`.
            clock: for arrival times.

        Raises:
            ValueError: PyAV is missing.
        """
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise ValueError(f"{place.name}: cameras and videos need PyAV: pip install 'droguekit[video]'") from error
        self.name, self._place, self._view, self._clock = place.name, place, view, clock
        self._container: InputContainer | None = None

    def open(self) -> None:
        """See `ImageStream`."""
        import av

        place = self._place
        timeout = None if place.timeout_s is None else (place.timeout_s, place.timeout_s)
        try:
            self._container = av.open(place.url, format=place.format, options=dict(place.options), timeout=timeout)
        except av.error.ExitError as error:
            raise ValueError(f"{self.name}: nothing answered for {place.timeout_s:g} s") from error
        except av.FFmpegError as error:
            raise ValueError(f"{self.name}: cannot be opened: {error.strerror}") from error
        try:
            self._check_container(self._container)
        except ValueError:
            self._container.close()
            raise
        decoder = self._container.streams.video[0].codec_context
        if decoder.name == "h264":
            # It marks images with parts that it made up only where one thread decodes each; and by the option below,
            # it refuses images for remarks (SEI) in which makers of cameras are careless.
            decoder.thread_count = 1
        else:
            decoder.options = {"err_detect": "crccheck+explode"}

    def _check_container(self, container: InputContainer) -> None:
        count = len(container.streams.video)
        if count != 1:
            raise ValueError(f"{self.name}: must have one video stream with both views side by side, got {count}")
        if self._place.is_file and self._is_unstamped(container):
            raise ValueError(f"{self.name}: holds no time stamps; put it into a container such as .mkv")

    def images(self, stop: threading.Event, left_out: Counter[str]) -> Iterator[CapturedImage]:
        """See `ImageStream`. After damage, images are left out until one that depends on no other."""
        assert self._container is not None
        with self._container as container:
            is_unstamped = self._is_unstamped(container)
            cleanness = _Cleanness()
            for packet, arrived_s in self._packets(container, stop, left_out, cleanness):
                frames = self._frames(packet, left_out, cleanness)
                # The last packet gives several images; the wait for the time of each is no decoding.
                decode_s = self._clock.now_s() - arrived_s
                for frame in frames:
                    self._check_frame(frame)
                    if not cleanness.accepts(frame):
                        left_out[DAMAGED] += 1
                    elif frame.pts is None or frame.time_base is None:
                        left_out[UNSTAMPED] += 1
                    else:
                        time_s = arrived_s if is_unstamped else float(frame.pts * frame.time_base)
                        yield CapturedImage(
                            self._view, time_s, arrived_s, decode_s, partial(pixels_of_frame, frame, self.name)
                        )

    def _packets(
        self, container: InputContainer, stop: threading.Event, left_out: Counter[str], cleanness: _Cleanness
    ) -> Iterator[tuple[Packet, float]]:
        """Packets and their arrival times."""
        import av

        errors, was_corrupt, packets = 0, False, container.demux(container.streams.video[0])
        while not stop.is_set():
            try:
                packet = next(packets)
            except StopIteration:
                return
            except av.error.ExitError as error:
                raise ValueError(f"{self.name}: no image came for {self._place.timeout_s:g} s") from error
            except av.error.InvalidDataError as error:
                errors += 1
                if errors > _MOST_ERRORS:
                    raise ValueError(f"{self.name}: sends nothing but damaged data") from error
                left_out[DAMAGED] += 1
                cleanness.lose(None)
                packets = container.demux(container.streams.video[0])
                continue
            except av.FFmpegError as error:
                raise ValueError(f"{self.name}: went away: {error.strerror}") from error
            errors = 0
            # Where a parser cuts a stream into images, it flags the image before the damaged one.
            if packet.is_corrupt or was_corrupt:
                cleanness.lose(packet.pts)
            was_corrupt = packet.is_corrupt
            yield packet, self._clock.now_s()

    def _frames(self, packet: Packet, left_out: Counter[str], cleanness: _Cleanness) -> list[VideoFrame]:
        import av

        try:
            return cast(list["VideoFrame"], list(packet.decode()))
        except av.FFmpegError:
            left_out[DAMAGED] += 1
            cleanness.lose(packet.pts)
            return []

    def _check_frame(self, frame: VideoFrame) -> None:
        if frame.rotation:
            raise ValueError(
                f"{self.name}: asks to be turned by {frame.rotation} degrees; calibrate and record without rotation"
            )
        if frame.interlaced_frame:
            raise ValueError(
                f"{self.name}: is interlaced, so that lines of one image are of two times; use progressive"
            )

    def _is_unstamped(self, container: InputContainer) -> bool:
        return bool(container.format.flags & _HAS_NO_STAMPS)


class _Cleanness:
    """Whether an image is free of what was lost before it.

    A decoder hides lost data by older images, flags the first image at most, and builds the next ones on it.
    """

    def __init__(self) -> None:
        self._is_clean = False
        self._lost_pts: int | None = None

    def lose(self, pts: int | None) -> None:
        """Data of an image were lost or damaged."""
        self._is_clean = False
        if pts is not None:
            self._lost_pts = pts if self._lost_pts is None else max(pts, self._lost_pts)

    def accepts(self, frame: VideoFrame) -> bool:
        """Whether a frame is clean, by itself or since a key frame."""
        if frame.is_corrupt:
            self.lose(frame.pts)
        elif frame.key_frame and (self._lost_pts is None or frame.pts is None or frame.pts > self._lost_pts):
            self._is_clean = True
        return self._is_clean


def pixels_of_frame(frame: VideoFrame, name: str) -> LoadedImage:
    """The pixels of a frame.

    R, G, B and grey stay as they are; Bayer mosaics are interpolated as in bags; Y, Cb, Cr of 8 bits are converted by
    the matrix and the range that the frame names, or by those of BT.601 and limited range where it names none.

    Raises:
        ValueError: another pixel format or matrix; names the stream.
    """
    kind, bits = frame.format.name, {component.bits for component in frame.format.components}
    if kind == "gray":
        return LoadedImage(_as_bytes(frame))
    if kind in _DEEP:
        pixels = frame.to_ndarray()
        pixels = pixels[:, :, ::-1] if kind.startswith("bgr") else pixels
        return LoadedImage(np.ascontiguousarray(pixels, dtype=np.uint16))
    pattern = kind.removesuffix("8")
    if pattern in BAYER_TO_RGB:
        mosaic = _as_bytes(frame)
        colors = np.asarray(cv2.cvtColor(mosaic, BAYER_TO_RGB[pattern]))
        return LoadedImage(colors, mosaic if pattern == "bayer_rggb" else None)
    if bits != {8} or frame.format.has_palette or len(frame.format.components) < 3:
        raise ValueError(f"{name}: images of the format {kind} are not read; send RGB, grey, or 8-bit YUV")
    if frame.format.is_rgb:
        return LoadedImage(_as_bytes(frame.reformat(format="rgb24")))
    named = int(frame.colorspace)
    matrix = _MATRICES.get(named)
    if matrix is None:
        raise ValueError(
            f"{name}: colours by the matrix {named} of ITU-T H.273 are not read; send RGB, grey, or YUV of BT.601, "
            "BT.709 or BT.2020"
        )
    is_full = frame.color_range == _FULL or kind.startswith("yuvj")
    converted = frame.reformat(
        format="rgb24",
        src_colorspace=matrix,
        # PyAV forwards matrix and range only where those of the result differ; R, G, B have none.
        dst_colorspace=_BT601 if matrix == _BT709 else _BT709,
        src_color_range=_FULL if is_full else _LIMITED,
        dst_color_range=_FULL,
        interpolation=_CONVERSION,
    )
    return LoadedImage(_as_bytes(converted))


def _as_bytes(frame: VideoFrame) -> Pixels:
    return np.ascontiguousarray(frame.to_ndarray(), dtype=np.uint8)


def libav_place(
    source: str, size_px: tuple[int, int], timeout_s: float, camera_format: str | None, rate_hz: float | None
) -> LibavPlace:
    """What a SOURCE of the command line names.

    Args:
        source: number or file of a video device, a video file, or an address.
        size_px: (width, height) to ask a device for. [px]
        timeout_s: longest wait for a network's data. [s]
        camera_format: libav's name of the pixel format or codec to ask a device for, or None.
        rate_hz: to ask a device for, or None. [Hz]

    Raises:
        ValueError: there is no such device or file, or it is not a device and a format or rate is asked for.
    """
    device = Path(f"/dev/video{source}") if source.isdecimal() else Path(source)
    is_device = source.isdecimal() or device.is_char_device()
    if not is_device and (camera_format is not None or rate_hz is not None):
        got = without_secrets(source)
        raise ValueError(f"--camera-format, --rate: with --live only devices such as 0 can be asked, got {got}")
    if is_device:
        if not device.exists():
            there = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*"))) or "no video devices"
            raise ValueError(f"--live: there is no {device}; there are {there}")
        options = {"video_size": f"{size_px[0]}x{size_px[1]}"}
        if camera_format is not None:
            options["input_format"] = camera_format
        if rate_hz is not None:
            options["framerate"] = f"{rate_hz:g}"
        return LibavPlace(str(device), str(device), "v4l2", options)
    if "://" in source:
        # Over UDP, which is RTSP's default, a lost packet damages images until the next key frame.
        options = {"rtsp_flags": "prefer_tcp"} if source.startswith("rtsp") else {}
        return LibavPlace(without_secrets(source), source, None, options, timeout_s)
    if not device.exists():
        raise ValueError(f"--live: there is no file {source}; give a device's number, a video file or an address")
    # Without the scheme, libav takes what is before a colon in the name for one.
    is_file = device.is_file()
    return LibavPlace(source, f"file:{source}", is_file=is_file, timeout_s=None if is_file else timeout_s)


def without_secrets(address: str) -> str:
    """An address as it may be printed: without user, password and query, also where some cameras put it in the path."""
    if "://" not in address:
        return address
    nothing = f"{address.partition('://')[0]}://..."
    try:
        parts = urlsplit(address)
        _ = parts.port
    except ValueError:
        # Letters where the port should be are the rest of a password, which has a / or the like in it.
        return nothing
    _, at, place = parts.netloc.rpartition("@")
    if not at and ":" in place and "@" in address:
        # What looks like a port may be the beginning of such a password.
        return nothing
    path = "/".join("..." if "=" in name else name for name in parts.path.split("/"))
    query = "?..." if parts.query or parts.fragment else ""
    return f"{parts.scheme}://{place}{path}{query}"
