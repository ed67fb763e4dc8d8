from __future__ import annotations

import pytest

from droguekit.capture.live_pairs import CaptureSettings, open_source
from geometry.stereo import paper_rig
from nav.realtime import MonotonicClock


def test_two_network_streams_are_refused_without_their_passwords() -> None:
    text = "rtsp://me:secret@left/stereo,rtsp://me:secret@right/stereo"
    with pytest.raises(ValueError, match=r"from two devices, .* got 'rtsp://left/stereo,rtsp://right/stereo'"):
        open_source(text, CaptureSettings(), paper_rig(), MonotonicClock())


@pytest.mark.parametrize("other", ["/dev/null", "/dev/../dev/null"])
def test_one_device_is_not_both_eyes(other: str) -> None:
    with pytest.raises(ValueError, match="two views must come from two devices"):
        open_source(f"/dev/null,{other}", CaptureSettings(), paper_rig(), MonotonicClock())


def test_one_topic_is_not_both_eyes() -> None:
    with pytest.raises(ValueError, match="must be ros:/LEFT,/RIGHT, two topics, got 'ros:/a,/a'"):
        open_source("ros:/a,/a", CaptureSettings(), paper_rig(), MonotonicClock())
