from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from studies.detector_weights.plain_grounds import write_plain_grounds


def test_every_third_ground_is_even_and_every_second_grey(tmp_path: Path) -> None:
    write_plain_grounds(tmp_path / "grounds", 12)
    files = sorted((tmp_path / "grounds").iterdir())
    grounds = [np.asarray(cv2.imread(str(file)), dtype=float) for file in files]
    assert len({file.read_bytes() for file in files}) == 12
    assert [float(np.ptp(ground, axis=(0, 1)).max()) == 0 for ground in grounds] == [n % 3 == 0 for n in range(12)]
    assert [float(np.ptp(ground, axis=2).max()) == 0 for ground in grounds] == [n % 2 == 1 for n in range(12)]
    write_plain_grounds(tmp_path / "again", 12)
    assert [file.read_bytes() for file in sorted((tmp_path / "again").iterdir())] == [f.read_bytes() for f in files]
