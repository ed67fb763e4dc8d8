from __future__ import annotations

import pytest

from droguekit.capture.live_pairs import CaptureSettings, open_source
from geometry.stereo import paper_rig
from nav.realtime import MonotonicClock


@pytest.mark.parametrize("other", ["/dev/null", "/dev/../dev/null"])
def test_one_device_is_not_both_eyes(other: str) -> None:
    with pytest.raises(ValueError, match="two views must come from two devices"):
        open_source(f"/dev/null,{other}", CaptureSettings(), paper_rig(), MonotonicClock())
