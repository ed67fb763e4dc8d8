from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path

import pytest

from datasets_manifest.recipe.recipe import load_recipe, recipe_names
from drogue_models.untrusted_files import (
    MOST_NESTING,
    open_regular,
    parse_json,
    parse_toml,
    read_regular,
    read_text,
)


def test_a_pipe_is_refused_without_waiting_for_a_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="is a pipe, socket or device") as caught:
        read_regular(tmp_path / "pipe")
    assert caught.value.filename == str(tmp_path / "pipe")


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/null", "/dev/tty0"])
def test_a_device_is_refused(name: str, tmp_path: Path) -> None:
    if not Path(name).exists():
        pytest.skip(f"there is no {name}")
    (tmp_path / "link").symlink_to(name)
    for path in (Path(name), tmp_path / "link"):
        with pytest.raises(OSError, match="is a pipe, socket or device"):
            read_regular(path)


def test_a_folder_and_a_missing_file_keep_their_errors(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "none")


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_regular(path, most_bytes=5) == b"12345"
    with pytest.raises(OSError, match="has more than 4 bytes"):
        read_regular(path, most_bytes=4)
    # A file of a terabyte that takes no room on the disk.
    os.truncate(path, 2**40)
    with pytest.raises(OSError, match="has more than 1073741824 bytes"):
        read_regular(path)


def test_a_link_may_have_to_stay_in_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "a").write_text("mine")
    (tmp_path / "secret").write_text("secret")
    (folder / "inside").symlink_to("a")
    (folder / "outside").symlink_to(tmp_path / "secret")
    (tmp_path / "alias").symlink_to(folder)
    assert read_regular(tmp_path / "alias" / "inside", in_folder=True) == b"mine"
    assert read_regular(folder / "outside") == b"secret"
    with pytest.raises(OSError, match="leads outside its folder"):
        read_regular(folder / "outside", in_folder=True)


def test_text_may_have_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfname")
    assert read_text(tmp_path / "a") == "name"


@pytest.mark.parametrize("value", [{"a": [1, -2.5e-3, '\u00e9 [[[ \\" ]]'], "b": None}, [[[]]] * 3, "[" * 500, 10**299])
def test_json_is_read_as_by_the_library(value: object) -> None:
    text = json.dumps(value)
    assert parse_json(text) == parse_json(text.encode()) == json.loads(text)
    assert parse_json(json.dumps(value, ensure_ascii=False).encode("utf-16")) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested more than 100 levels"),
        ('{"a":' * 101 + "1" + "}" * 101, "nested more than 100 levels"),
        # Brackets in texts hide nothing.
        ('["]]]]]]]]", "\\"]]]]]]]]", ' + "[" * 101 + "]" * 102, "nested more than 100 levels"),
        ('{"a": NaN}', "holds NaN"),
        ("[-Infinity]", "holds -Infinity"),
        ("1" * 5000, "a number of 5000 digits"),
        ("", "Expecting value"),
    ],
)
def test_json_that_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_json(text)


def test_nesting_is_counted_beyond_a_block() -> None:
    text = '["' + "x" * 2**20 + '", ' + "[" * MOST_NESTING + "]" * MOST_NESTING + "]"
    with pytest.raises(ValueError, match="nested more than"):
        parse_json(text)
    assert parse_json(text.replace("[]", "1"))


def test_toml_is_read_as_by_the_library() -> None:
    for name in recipe_names():
        assert parse_toml(load_recipe(name).text) == tomllib.loads(load_recipe(name).text)
    texts = 'a = "[[[[ # \\" ]"\nb = \'\'\'[[ \' ["""\'\'\'\nc = """\n\\""" # [[[ """"\n'
    texts += "[d.'e.f']\ng = [1.5, 2.5] # \"[[\"\n"
    assert parse_toml(texts) == tomllib.loads(texts)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 100_000, "nested more than 100 levels"),
        ('a = "]]]]]]]]" \nb = ' + "[" * 101 + "]" * 101, "nested more than 100 levels"),
        # A key of so many parts would take gigabytes.
        (".".join(["a"] * 50_000) + " = 1", "nested more than 100 levels"),
        (" . ".join(["'a b'", '"c"'] * 60) + " = 1", "nested more than 100 levels"),
        ("a = " + "1" * 5000, "more than 300 digits"),
        ('a = "' + "x" * 2**20 + '"', "more than 1048576 characters"),
        ('a = """' + '\\"""' * 100_000, "Unterminated string"),
        ("a = 1 = 2", "not valid TOML"),
    ],
)
def test_toml_that_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_toml(text)
