"""Writes docs/reference/recipe-keys.md: every key of a recipe with its default, its range and what it is.

    .venv/bin/python scripts/recipe_keys.py

The text of a key comes from its class's docstring, its range from its field or from the check that its class makes.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin
from unittest.mock import patch

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from datasets_manifest.recipe.environment_ranges import EnvironmentMapRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.field_types import Range
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import DrogueParameters

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "recipe-keys.md"
HEAD = """# Keys of a recipe

Every key that a recipe's TOML file may have, its default, the values that are accepted, and what it is; the
[recipes'](recipes.md) sections are explained with examples in the pages that are named there. A *range* is a number, or
`[low, high]` for a uniform distribution between them. `drogue` and `[rig]` have pages of their own: [add a
drogue](../how-to/add-a-drogue.md), [the camera](conventions.md#the-camera).

`.venv/bin/python scripts/recipe_keys.py` makes this page.
"""
# Their tables in TOML are other classes, whose pages explain them.
_ELSEWHERE = ("drogue", "rig", "sensor")
# In TOML the file of an environment map stands under another name, and the rest follows from it.
_IN_TOML = {EnvironmentMapRanges: {"path": "file", "sha256": None, "folder": None}}
_SPACES = re.compile(r"\s+")


def page() -> str:
    """The page's text."""
    return "\n".join([HEAD, *_section(Recipe, "", set())]).rstrip() + "\n"


def _section(model: type[FrozenModel], place: str, seen: set[type[FrozenModel]]) -> Iterator[str]:
    """Heading and table of a class, then those of the classes that its fields hold; each class once."""
    seen.add(model)
    limits, in_toml = _limits(model), _IN_TOML.get(model, {})
    fields = {name: field for name, field in model.model_fields.items() if place or name not in _ELSEWHERE}
    if place:
        yield f"## `[{place}]`\n"
        yield f"{_summary(model)}\n"
    yield "| key | default | values | what it is |"
    yield "|---|---|---|---|"
    for name, field in fields.items():
        key = in_toml.get(name, name)
        if key is not None:
            values = _values(field.annotation, field.metadata, limits.get(name))
            yield f"| `{key}` | {_default(field)} | {values} | {_text(model, name, field.annotation)} |"
    yield ""
    # Families hold the other sections, which are to be explained where they stand alone.
    for name, field in sorted(fields.items(), key=lambda item: item[0] == "families"):
        for inner in _models(field.annotation):
            if inner not in seen and not issubclass(inner, DrogueParameters):
                yield from _section(inner, f"{place}.{name}" if place else name, seen)


def _summary(model: type[FrozenModel]) -> str:
    return _SPACES.sub(" ", (model.__doc__ or "").split("\n\n")[0].strip())


def _text(model: type[FrozenModel], name: str, annotation: Any) -> str:
    """What a class says of a key, with the words of the class that it refers to."""
    text = _said(model).get(name, "")
    if not text:
        text = " ".join(map(_summary, _models(annotation)))
    if not text:
        # Such as "units and meaning as in `Environment`".
        others = re.findall(r"`([A-Z]\w+)`", _summary(model))
        text = f"see `{others[0]}`" if others else ""
    refers = re.search(r"(^|, )see `([A-Z]\w+)(?:\.(\w+))?`", text)
    if refers is not None:
        there = _said(_CLASSES[refers[2]]).get(refers[3] or name, "")
        before, after = text[: refers.start()], text[refers.end() :].lstrip(".;, ")
        text = ". ".join(part.rstrip(".") for part in (before, there, after) if part)
    return text.rstrip(".").replace("|", r"\|")


def _said(model: type[FrozenModel]) -> dict[str, str]:
    """What the docstring of a class, or of one that it extends, says of each field."""
    found: dict[str, str] = {}
    for one in reversed(model.__mro__):
        _, _, attributes = (one.__doc__ or "").partition("Attributes:\n")
        for entry in re.split(r"\n {8}(?=\S)", f"\n{attributes}"):
            names, colon, text = entry.strip().partition(": ")
            if colon:
                found |= dict.fromkeys(re.split(r",\s*", names), _SPACES.sub(" ", text).strip())
    return found


def _subclasses(model: type) -> Iterator[type]:
    for one in model.__subclasses__():
        yield one
        yield from _subclasses(one)


_CLASSES = {one.__name__: one for one in _subclasses(FrozenModel)}


def _limits(model: type[FrozenModel]) -> dict[str, tuple[float, float]]:
    """Limits of ranges, as the class's validators check them when it is made with little but its defaults."""
    constants = vars(sys.modules[model.__module__])
    checks = re.findall(r"self\.(\w+)\.within\(([-\w.]+), ([-\w.]+),", inspect.getsource(model))
    found = {name: (_constant(low, constants), _constant(high, constants)) for name, low, high in checks}

    def note(self: Range, low: float, high: float, name: str) -> None:
        found[name.rpartition(".")[2]] = low, high

    needed = {name: _any_value(field.annotation) for name, field in model.model_fields.items() if field.is_required()}
    # Not every class takes any values; checks in a loop are not seen then.
    with patch.object(Range, "within", note), suppress(ValidationError):
        model(**needed)
    return found


def _any_value(annotation: Any) -> Any:
    """A value for a key that has no default: one of those to choose from, or a list of one; else None."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)[0]
    if get_origin(annotation) is tuple:
        return (_any_value(get_args(annotation)[0]),)
    if get_origin(annotation) in (Union, UnionType):
        return _any_value(get_args(annotation)[0])
    return None


def _constant(text: str, constants: Mapping[str, Any]) -> float:
    return float(constants.get(text, text))


def _models(annotation: Any) -> Iterator[type[FrozenModel]]:
    """The classes of tables that a field holds; a range is none."""
    if isinstance(annotation, type) and issubclass(annotation, FrozenModel) and annotation is not Range:
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined and field.default_factory is None:
        return "*needed*"
    value = field.get_default(call_default_factory=True, validated_data={})
    return _shown(value)


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, Range):
        return _number(value.low) if value.low == value.high else f"[{_number(value.low)}, {_number(value.high)}]"
    if isinstance(value, FrozenModel):
        return "its defaults"
    if isinstance(value, tuple):
        if any(isinstance(item, FrozenModel) for item in value):
            return "its defaults"
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return _number(value)
    return f"`{value}`" if str(value) else "empty"


def _number(value: float) -> str:
    return f"{int(value):_}" if value == int(value) else f"{value:g}"


def _values(annotation: Any, metadata: list[Any], limits: tuple[float, float] | None) -> str:
    """The kind of a value and its limits."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, UnionType):
        kinds = [_values(one, metadata, limits) for one in inner if one is not NoneType]
        return " or ".join(dict.fromkeys(kinds))
    if hasattr(annotation, "__metadata__"):
        return _values(annotation.__origin__, [*metadata, *annotation.__metadata__], limits)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner)
    if origin is tuple:
        kinds = list(dict.fromkeys(_values(one, [], limits) for one in inner if one is not Ellipsis))
        count = "" if Ellipsis in inner else f" {len(inner)}"
        return f"list of{count}: {'; '.join(kinds)}" + _bounds(metadata, " items")
    if annotation is Range:
        return "range" + (f" within {_number(limits[0])} to {_number(limits[1])}" if limits else "")
    if isinstance(annotation, type) and issubclass(annotation, FrozenModel):
        return "table"
    kind = {float: "number", int: "whole number", bool: "true or false", str: "text"}.get(annotation, "text")
    return kind + _bounds(metadata, " characters" if annotation is str else "")


def _bounds(metadata: list[Any], of: str) -> str:
    """Limits of a number or length in words."""
    flat = [part for item in metadata for part in (item.metadata if isinstance(item, FieldInfo) else [item])]
    words = []
    for part in flat:
        match part:
            case Ge(ge=low):
                words.append(f"from {_number(low)}")
            case Gt(gt=low):
                words.append(f"above {_number(low)}")
            case Le(le=high):
                words.append(f"to {_number(high)}")
            case Lt(lt=high):
                words.append(f"below {_number(high)}")
            case MinLen(min_length=low) if low > 1:
                words.append(f"at least {_number(low)}{of}")
            case MaxLen(max_length=high):
                words.append(f"{'and ' if words else ''}at most {_number(high)}{of}")
    return f", {' '.join(words)}" if words else ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
