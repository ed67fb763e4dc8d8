"""Poses from arrays of pixels."""

from __future__ import annotations

import math
import operator
from pathlib import Path
from typing import Literal

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.estimates import Estimate
from datasets_manifest.types.images import Pixels, StereoImages
from drogue_models.parameters import DrogueParameters
from droguekit.numerical_threads import one_thread
from geometry.stereo import StereoRig
from nav.detector.detector_registry import DEFAULT_DETECTOR
from nav.pair_navigator import CENTROID_CHOICES, CentroidChoice
from nav.runner import open_navigator
from nav.sequence_navigator import SequenceSettings
from scenes.sampler import FRAME_PERIOD_S

# Of 12 bits.
_MOST_DN = 4095
_MOST_DN_OF_8_BITS = 255


class Navigator:
    """Estimates the pose of one drogue with one rig, pair by pair.

    Without a tracker and a filter each pair is estimated by itself, unless its lamps blink: these are followed from
    pair to pair for the roll. With any of the three, pairs must come in the order of time.

    Examples:
        >>> navigator = droguekit.Navigator(dataset.rig, dataset.drogue)
        >>> estimate = navigator(pair.left, pair.right)
    """

    def __init__(
        self,
        rig: StereoRig,
        drogue: DrogueParameters,
        method: str = "joint-hub",
        detector: str | Path = DEFAULT_DETECTOR,
        *,
        encoding: Literal["linear", "gamma"] = "linear",
        black_level_dn: float = 0.0,
        centroids: CentroidChoice = "own",
        tracker: str | None = None,
        filtered: bool = False,
    ) -> None:
        """Open the detector.

        Args:
            rig: the cameras.
            drogue: the drogue to look for.
            method: name of a pose method, see `droguekit navigate --help`.
            detector: name of a shipped one, or a network file `*.onnx`; a network also with the height and width of its
                input behind it, as in `mobile-s@960x1280`.
            encoding: of the arrays that are passed in: `linear` in the light, as the shipped recipes render, or `gamma`
                (the sRGB curve), as most cameras deliver 8 bits. A wrong one costs accuracy.
            black_level_dn: pixel value without light. [DN]
            centroids: how centres of markers are measured, one of `own`, `binary`, `edge`.
            tracker: name of a tracker that follows the drogue from pair to pair; the detector runs on every pair when
                None.
            filtered: whether to return the filtered pose instead of the measured one.

        Raises:
            ValueError: a method, detector, tracker or way to measure centres that does not exist, or a black level that
                no image has.
        """
        if centroids not in CENTROID_CHOICES:
            raise ValueError(f"centroids: must be one of {', '.join(CENTROID_CHOICES)}, got {centroids!r}")
        if encoding not in ("linear", "gamma"):
            raise ValueError(f"encoding: must be linear or gamma, got {encoding!r}")
        if not 0 <= black_level_dn <= _MOST_DN:
            raise ValueError(f"black_level_dn: must be from 0 to {_MOST_DN}, got {black_level_dn}")
        self.rig, self.drogue = rig, drogue
        self._encoding: Literal["linear", "gamma"] = encoding
        self._black_level_dn = black_level_dn
        settings = SequenceSettings((method,), centroids, tracker, filtered=filtered)
        self._navigator = open_navigator(settings, str(detector))
        self._next_index = 0

    def __call__(self, left: Pixels, right: Pixels, *, time_s: float | None = None) -> Estimate:
        """Estimate the pose in one pair of undistorted or distorted images, as the rig's lenses tell.

        Args:
            left: (H, W, 3) in the order red, green, blue, or (H, W); uint8, or 12 significant bits in uint16.
            right: as `left`.
            time_s: mid-exposure; without it pairs are 0.04 s apart. A drogue whose lamps blink needs it, on the clock
                of its `marker_code`. [s]

        Returns:
            A `PoseEstimate`, or a `NoFix` with the reason.

        Raises:
            ValueError: arrays of another type, of different shapes, or with more than 12 bits, a black level beyond
                their largest number, a time that is no finite number, or none where lamps blink.
        """
        if time_s is None and self.drogue.marker_code is not None:
            raise ValueError("time_s: a drogue whose lamps blink needs the time of the images, got None")
        if time_s is not None and not math.isfinite(time_s):
            raise ValueError(f"time_s: must be a finite number, got {time_s}")
        if left.dtype == "uint8" and self._black_level_dn > _MOST_DN_OF_8_BITS:
            raise ValueError(
                f"black_level_dn: must be from 0 to {_MOST_DN_OF_8_BITS} for uint8 images, got {self._black_level_dn}"
            )
        most_dn = max((int(each.max()) for each in (left, right) if each.dtype == "uint16"), default=0)
        if most_dn > _MOST_DN:
            raise ValueError(f"images: must have 12 significant bits in the low end of uint16, got the value {most_dn}")
        return self.estimate(
            StereoImages(
                left=left,
                right=right,
                time_s=FRAME_PERIOD_S * self._next_index if time_s is None else time_s,
                exposure_s=0.0,
                bits=8 if left.dtype == "uint8" else 12,
                encoding=self._encoding,
                black_level_dn=self._black_level_dn,
            ),
            self._next_index,
        )

    def estimate(self, images: StereoImages, frame_index: int | None = None) -> Estimate:
        """Estimate the pose in images that carry their own time, bits, encoding and black level.

        Args:
            images: such as `StereoPair.images`.
            frame_index: that the estimate gets; pairs are counted from 0 without it.

        Raises:
            ValueError: a negative index.
            TypeError: an index that is no whole number.
        """
        index = self._next_index if frame_index is None else operator.index(frame_index)
        if index < 0:
            raise ValueError(f"frame_index: must not be negative, got {index}")
        with one_thread():
            estimates = self._navigator.process(BlindPair(index, images, self.rig, self.drogue)).estimates
        self._next_index = index + 1
        return estimates[-1]
