"""Calibrations that no parser reads: the error names file and place in plain words, without the parser's own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from datasets_manifest.calibration.calibration_reader import read_calibration
from tests.support.stereo_calibrations import EVERYTHING, storage

OPENCV = "%YAML:1.0\n---\n"
MATRIX = "!!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
# What only the parsers call things: their source files, functions, classes and buffers.
JARGON = re.compile(r"cv2|OpenCV\(|\.cpp|error: \(|in function|exception set|<class|unicode string|\^|recursion")


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("a.yaml", "cam0: [1, 2\ncam1: }", "line 2, column 5: expected ',' or ']', but got ':'"),
        ("header.yaml", "%YAML:1.0\n---\ncam0: }", "line 3, column 7: "),
        ("alias.yaml", "cam0: *a\n", "line 1, column 7: found undefined alias 'a'"),
        ("tag.yaml", "cam0: !!python/object:os.system x\n", "line 1, column 7: could not determine a constructor"),
        ("tab.yaml", "a:\n\tb: 1\n", r"line 2, column 1: found character '\\t'"),
        ("nul.yaml", "a: \0b", "it holds the character 0x00, which is not allowed in YAML"),
        ("date.yaml", "a: 2001-99-99\n", "month must be in 1..12"),
        ("indent.yml", f"{OPENCV}M1: {MATRIX}  data: [ 1, 2\n", "line 7: Incorrect indentation;"),
        ("tab.yml", f"{OPENCV}M1: !!opencv-matrix\n\trows: 3\n", "line 4: Tabs are prohibited in YAML;"),
        ("half.xml", '<?xml version="1.0"?>\n<opencv_storage>\n<M1><rows>3', "line 3: Invalid input;"),
        ("half.json", '{"M1": [1,2', "line 1: it ends too early;"),
        ("list.yml", f"{OPENCV}- {MATRIX}", "it holds no table of names and values"),
    ],
)
def test_the_place_is_named_in_plain_words(name: str, text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=rf"{name}: is not .*{fault}.* write it anew$") as caught:
        read_calibration([tmp_path / name])
    assert JARGON.search(str(caught.value).replace(str(tmp_path), "")) is None


def test_a_matrix_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    storage(path, EVERYTHING)
    text = path.read_text()
    start = text.index("M2:")
    # Of nine numbers one is left.
    path.write_text(text[:start] + re.sub(r"data: \[[^]]*\]", "data: [ 1. ]", text[start:], count=1))
    with pytest.raises(ValueError, match=r"stereo\.yml: M2: must be numbers, got none that can be read"):
        read_calibration([path])
