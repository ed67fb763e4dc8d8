"""The sheet of clouds shows every kind, each as something else than clear sky."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

from datasets_manifest.types.environment import CloudKind
from studies.realism.__main__ import main
from studies.realism.cloud_sheet import KINDS, cloud_picture, write_cloud_sheet


def test_every_kind_of_cloud_is_on_the_sheet() -> None:
    assert set(get_args(CloudKind)) <= set(KINDS)


@pytest.mark.parametrize("kind", ["cumulus", "contrail", "stratus"])
def test_a_picture_is_neither_clipped_nor_dark_and_shows_cloud_before_sky(kind: str) -> None:
    picture = cloud_picture(kind, 80).astype(float)
    assert picture.shape == (60, 80, 3)
    # White is 1/0.9 of the 99.5th percentile: half a percent of 4,800 pixels may reach it.
    assert np.mean(picture.min(axis=-1) >= 255) <= 0.005
    blue_over_red = picture[..., 2] / picture[..., 0]
    # Cloud is white and the sky blue.
    assert np.mean(blue_over_red < 1.1) > 0.02
    assert np.mean(blue_over_red > 1.25) > 0.02


def test_the_sheet_is_written_and_other_endings_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cloud_sheet(tmp_path / "clouds.png", tile_px=24)
    sheet = cv2.imread(str(tmp_path / "clouds.png"))
    assert sheet is not None
    assert sheet.shape == (36, 96, 3)
    assert main(["cloud-sheet", "--out", str(tmp_path / "clouds.gif")]) == 2
    assert "clouds.gif must end with .jpg, .jpeg, .png" in capsys.readouterr().err
