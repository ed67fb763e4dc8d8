from __future__ import annotations

import json

import pytest

from datasets_manifest.types.images import PixelValues, parse_pixel_values

VALUES = PixelValues(stamp_ns=1403636579763555584, encoding="gamma", black_level_dn=4.5, bits=12, exposure_s=0.002)


def test_text_reads_back_the_same() -> None:
    assert parse_pixel_values(VALUES.as_text()) == VALUES


@pytest.mark.parametrize(
    ("key", "value"),
    [("encoding", "log"), ("black_level_dn", -1), ("bits", 32), ("exposure_s", None), ("stamp_ns", "x"), ("iso", 100)],
)
def test_another_text_is_refused_by_the_name_of_its_key(key: str, value: object) -> None:
    with pytest.raises(ValueError, match=key):
        parse_pixel_values(json.dumps(json.loads(VALUES.as_text()) | {key: value}))


@pytest.mark.parametrize("text", ["", "linear", "[]", "null"])
def test_a_text_that_is_no_object_is_one_line(text: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_pixel_values(text)
    assert str(error.value) and "\n" not in str(error.value)
