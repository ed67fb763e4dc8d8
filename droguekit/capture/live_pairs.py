"""Pairs of a running camera as navigation takes them: numbered, of the calibrated size, with their numbers' meaning."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from datasets_manifest.importers.imported_dataset import ImportedPair, PixelDepth
from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from droguekit.capture.libav_stream import LibavStream, libav_place
from droguekit.capture.ros_topics import RosTopics
from droguekit.capture.stereo_source import CapturedPair, LoadedImage, RunningCamera, StereoSource, VideoPlayback
from geometry.stereo import StereoRig
from nav.realtime import ArrivedPair, Clock

_ROS = "ros:"


@dataclass(frozen=True)
class CameraSettings:
    """What a camera's images do not say.

    Attributes:
        rig: the cameras.
        drogue: the drogue to look for.
        encoding: of the pixel values; by default `gamma` for 8 bits and `linear` for more.
        black_level_dn: pixel value without light, in the delivered images. [DN]
        bits: significant bits of images with more than 8; must be given for those.
    """

    rig: StereoRig
    drogue: DrogueParameters
    encoding: Literal["linear", "gamma"] | None = None
    black_level_dn: float = 0.0
    bits: int | None = None


class LivePairs:
    """See `PairSource`: the pairs of a camera.

    Attributes:
        source: that delivers them.
        fault: what ended it, or None; pairs that had arrived are processed all the same.
        description: of the images, once the first pair is there.
    """

    def __init__(self, source: StereoSource, settings: CameraSettings) -> None:
        """Prepare; the source is opened by the first request for a pair."""
        self.source = source
        self.fault: str | None = None
        self.description = ""
        self._settings = settings
        self._depth: PixelDepth | None = None
        self._arrived_s: tuple[float, ...] = ()
        self._count = 0

    def stop(self) -> None:
        """See `PairSource`."""
        self.source.stop()

    @property
    def rate_hz(self) -> float:
        """Mean rate of arrival; 0 for fewer than two pairs. [Hz]"""
        if self._count < 2:
            return 0.0
        first_s, last_s = self._arrived_s
        return (self._count - 1) / max(last_s - first_s, 1e-9)

    def arrivals(self) -> Iterator[ArrivedPair]:
        """See `PairSource`."""
        try:
            for captured in self.source.pairs():
                pair = BlindPair(self._count, self._images(captured), self._settings.rig, self._settings.drogue)
                self._arrived_s = (*self._arrived_s[:1], captured.arrived_s)
                self._count += 1
                yield ArrivedPair(pair, captured.arrived_s, captured.read_s)
        except (ValueError, OSError) as error:
            self.fault = " ".join(str(error).split())

    def _images(self, captured: CapturedPair) -> StereoImages:
        """The pair as navigation takes it.

        Raises:
            ValueError: of another size than calibrated, or of another depth or colour than the first pair; names it.
        """
        settings = self._settings
        if self._depth is None:
            if captured.left.pixels.dtype == np.uint16 and settings.bits is None:
                raise ValueError(f"{self.source.name}: sends 16-bit numbers; give the camera's own depth by --bits")
            views = captured.left.pixels, captured.right.pixels, captured.left.mosaic, captured.right.mosaic
            names = (self.source.name, self.source.name)
            self._depth = PixelDepth(ImportedPair(names, captured.time_s, *views), settings.bits)
        depth = self._depth
        left = self._checked(captured.left, captured.names[0], depth)
        right = self._checked(captured.right, captured.names[1], depth)
        images = StereoImages(
            left=left.pixels,
            right=right.pixels,
            time_s=captured.time_s,
            exposure_s=0.0,
            bits=depth.output_bits,
            encoding=depth.encoding(settings.encoding),
            black_level_dn=depth.kept_level_dn(settings.black_level_dn),
            left_mosaic=left.mosaic,
            right_mosaic=right.mosaic,
        )
        if not self.description:
            self.description = self._describe(images)
        return images

    def _checked(self, view: LoadedImage, name: str, depth: PixelDepth) -> LoadedImage:
        name = f"{self.source.name}: {name} {self._count}"
        if (view.mosaic is None) == (depth.color == "bayer"):
            raise ValueError(f"{name}: must have the colours of the first pair")
        rig, mosaic = self._settings.rig, view.mosaic
        kept = None if mosaic is None else depth.checked(mosaic, name, rig, is_mosaic=True)
        return LoadedImage(depth.checked(view.pixels, name, rig), kept)

    def _describe(self, images: StereoImages) -> str:
        """What the numbers are taken to be, as one line."""
        rig, (width, height) = self._settings.rig, images.size_px
        colors = "RGB" if images.left.ndim == 3 else "grey"
        bits = self._settings.bits or images.bits
        return (
            f"{self.source.name}: {width}x{height} px a view, {colors} of {bits} bits, {images.encoding} encoding, "
            f"black level {self._settings.black_level_dn:g}; baseline {rig.baseline_m:.4g} m, focal length "
            f"{rig.camera.fx_px:.5g} px"
        )


@dataclass(frozen=True)
class CaptureSettings:
    """How to read a camera.

    Attributes:
        timeout_s: longest wait for a pair. [s]
        tolerance_ms: largest difference of the time stamps of left and right. [ms]
        camera_format: libav's name of the pixel format or codec to ask a device for, or None.
        rate_hz: to ask a device for, or None. [Hz]
    """

    timeout_s: float = 5.0
    tolerance_ms: float = 1.0
    camera_format: str | None = None
    rate_hz: float | None = None


def open_source(text: str, settings: CaptureSettings, rig: StereoRig, clock: Clock) -> StereoSource:
    """The source that a SOURCE of the command line names.

    Args:
        text: a device's number or file, two of them, a video file, an address, or `ros:LEFT,RIGHT`.
        settings: how to read it.
        rig: with the sizes to ask devices for.
        clock: for arrival times.

    Raises:
        ValueError: there is no such source, or a package that it needs is missing.
    """
    width_px, height_px = rig.camera.width_px, rig.camera.height_px
    asked = settings.camera_format, settings.rate_hz
    if text.startswith(_ROS):
        topics = tuple(text.removeprefix(_ROS).split(","))
        if len(topics) != 2 or topics[0] == topics[1] or not all(topic.startswith("/") for topic in topics):
            raise ValueError(f"--live: must be ros:/LEFT,/RIGHT, two topics, got {text!r}")
        if asked != (None, None):
            raise ValueError("--camera-format, --rate: with --live only devices such as 0 can be asked, not topics")
        ros = RosTopics((topics[0], topics[1]), settings.timeout_s, clock)
        return RunningCamera(ros.name, [ros], clock, settings.timeout_s, 1e-3 * settings.tolerance_ms)
    parts = text.split(",")
    addresses = ["://" in part for part in parts]
    if len(parts) == 2 and addresses[0] == addresses[1] and not Path(text).exists():
        places = [libav_place(part, (width_px, height_px), settings.timeout_s, *asked) for part in parts]
        one, other = (Path(place.url).resolve() for place in places)
        if any(place.format is None for place in places) or one == other:
            got = ",".join(place.name for place in places)
            raise ValueError(
                f"--live: two views must come from two devices, whose time stamps are of one clock, got {got!r}; "
                "join streams side by side, or use topics of ROS 2"
            )
        streams = [LibavStream(place, view, clock) for view, place in enumerate(places)]
        return RunningCamera(text, streams, clock, settings.timeout_s, 1e-3 * settings.tolerance_ms)
    place = libav_place(text, (2 * width_px, height_px), settings.timeout_s, *asked)
    stream = LibavStream(place, None, clock)
    if place.is_file:
        return VideoPlayback(stream, clock, settings.timeout_s)
    return RunningCamera(stream.name, [stream], clock, settings.timeout_s, 1e-3 * settings.tolerance_ms)
