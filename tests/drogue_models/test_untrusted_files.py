from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import threading
import tomllib
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from datasets_manifest.recipe.recipe import load_recipe, recipe_names
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import HubParameters
from drogue_models.presets import MOST_FAULTS, explain
from drogue_models.untrusted_files import (
    MOST_DIGITS,
    MOST_MEMORY_BYTES,
    MOST_NESTING,
    limited_memory,
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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-32"])
def test_numbers_may_have_so_many_digits(encoding: str) -> None:
    digits = ("9876543210" * MOST_DIGITS)[:MOST_DIGITS]
    assert parse_json(f'["\u0664", {digits}]'.encode(encoding)) == ["\u0664", int(digits)]
    with pytest.raises(ValueError, match=f"a number of {MOST_DIGITS + 1} digits"):
        parse_json(f"[{digits}0]".encode(encoding))
    # In a text, and in a float, they are no whole number.
    assert parse_json(f'["{digits}0", 0.{digits}0]'.encode(encoding))[0] == f"{digits}0"


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


def test_a_library_gets_so_much_more_memory_and_no_more() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with limited_memory(0):
        assert np.empty(MOST_MEMORY_BYTES // 2, np.uint8).size
    with (
        pytest.raises(ValueError, match=f"takes more than {MOST_MEMORY_BYTES + 64000} bytes of memory"),
        limited_memory(1000),
    ):
        np.empty(MOST_MEMORY_BYTES + 2**26, np.uint8)
    with limited_memory(2**25):
        assert np.empty(MOST_MEMORY_BYTES + 2**26, np.uint8).size
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_blocks_of_several_threads_share_the_widest_limit() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    is_open, may_end = threading.Event(), threading.Event()

    def hold() -> None:
        with limited_memory(2**25):
            is_open.set()
            may_end.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    assert is_open.wait(60)
    with limited_memory(0):
        assert np.empty(MOST_MEMORY_BYTES + 2**26, np.uint8).size
        may_end.set()
        thread.join()
        # The limit stays until the last block ends.
        assert resource.getrlimit(resource.RLIMIT_DATA) != before
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_a_tighter_limit_from_outside_stays() -> None:
    code = (
        "import resource\nfrom drogue_models.untrusted_files import limited_memory\n"
        "most = 2**30 // 2\nresource.setrlimit(resource.RLIMIT_DATA, (most, resource.RLIM_INFINITY))\n"
        "with limited_memory(0):\n    assert resource.getrlimit(resource.RLIMIT_DATA)[0] == most\n"
        "assert resource.getrlimit(resource.RLIMIT_DATA)[0] == most"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_list_of_wrong_items_is_told_by_its_first_one() -> None:
    class Item(FrozenModel):
        one: int
        two: int

    class Table(FrozenModel):
        items: tuple[Item, ...]
        pair: tuple[float, float]

    with pytest.raises(ValidationError) as caught:
        Table.model_validate({"items": [{}] * 1000, "pair": ["a", "b"]})
    assert explain(caught.value).count("Field required") == 2
    # Of a fixed number of places each is told.
    assert [fault["loc"] for fault in caught.value.errors()][2:] == [("pair", 0), ("pair", 1)]


def test_of_many_faults_the_first_ones_are_told() -> None:
    with pytest.raises(ValidationError) as caught:
        HubParameters.model_validate({f"key{number}" + "x" * 5000: "y" * 5000 for number in range(1000)})
    told = explain(caught.value)
    assert told.endswith(f"; and {1000 - MOST_FAULTS} more faults")
    assert told.count("key") == MOST_FAULTS and len(told) < MOST_FAULTS * 600
