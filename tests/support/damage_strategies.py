"""How a file is damaged, how often, and which errors count as clear."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from datetime import timedelta

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

Edit = Callable[[bytes], bytes]

# The suite's share of 500; `make fuzz` sets the variable.
TIMES = int(os.environ.get("DROGUEKIT_FUZZ_TIMES", "1"))


def fuzz(examples: int) -> settings:
    """Settings of one test; the suite's draws are always the same, those of `make fuzz` are new each time."""
    return settings(
        max_examples=examples * TIMES,
        derandomize=TIMES == 1,
        database=None,
        # Far beyond what any example takes on a busy machine: this is for what hangs.
        deadline=timedelta(minutes=2),
        suppress_health_check=list(HealthCheck),
        # Examples are small already, and to make them smaller takes minutes.
        phases=(Phase.generate,),
    )


def quietly(action: Callable[[], object]) -> None:
    """Run what may fail by a clear error only."""
    try:
        action()
    except (ValueError, OSError) as error:
        assert str(error) and "\n" not in str(error).strip(), repr(error)


# What a careless program or an enemy writes in the place of a value.
_NUMBERS = [True, -1, 0, 2**31, 2**63, 10**30, 1e308, -1e-308, float("nan"), float("inf")]
_TEXTS = ["", "left", "../../secret", "/etc/passwd", "a/../../b", "\0", "x" * 5000, "\u00e9\ud800"]
HOSTILE = st.sampled_from([None, *_NUMBERS, *_TEXTS, [], {}, [[]], [None] * 40, {"left": 1}, [1e200] * 3])


# What parsers choke on: nesting, a number of many digits, a key of many parts, control characters, other digits.
_MONSTERS = [b"[" * 20_000, b'{"a":' * 5_000, b"1" * 5_000, b"a." * 20_000 + b"a = 1", b"<a>" * 5_000, b"- " * 5_000]
_MONSTERS += [b"\x1b]0;x\x07", "\u0663\u202e".encode(), b"NaN", b"1e999", b"&a [*a, *a]", b'"' * 99]


@st.composite
def byte_edits(draw: st.DrawFn) -> Edit:
    """A change of a file's bytes: cut, turn over, double, insert, and nested or endless numbers where text is read."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "double", "empty", "monster"]))
    monster = draw(st.sampled_from(_MONSTERS))
    place, length = draw(st.floats(0, 1, exclude_max=True)), draw(st.integers(1, 40))
    junk = draw(st.binary(min_size=1, max_size=40))

    def edit(data: bytes) -> bytes:
        at = int(place * len(data))
        if kind == "cut":
            return data[:at]
        if kind == "empty":
            return b""
        if kind == "double":
            return data[:at] + data
        if kind == "monster":
            return data[:at] + monster + data[at:]
        middle = junk if kind == "insert" else bytes(byte ^ junk[0] | 1 for byte in data[at : at + length])
        return data[:at] + middle + data[at + (0 if kind == "insert" else length) :]

    return edit


@st.composite
def json_edits(draw: st.DrawFn) -> Edit:
    """A change of one value, deep in a JSON file, or of a key."""
    steps, value = draw(st.lists(st.integers(0, 10**6), min_size=1, max_size=9)), draw(HOSTILE)
    kind = draw(st.sampled_from(["replace", "delete", "add"]))

    def edit(data: bytes) -> bytes:
        table = node = json.loads(data)
        for number, step in enumerate(steps):
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = keys[step % len(keys)]
            if number + 1 < len(steps) and isinstance(node[key], dict | list):
                node = node[key]
                continue
            if kind == "replace":
                node[key] = value
            elif kind == "delete":
                del node[key]
            elif isinstance(node, dict):
                node[str(value)] = node[key]
            else:
                node.append(value)
            break
        return json.dumps(table).encode("utf-8", "surrogatepass")

    return edit
