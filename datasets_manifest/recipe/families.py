"""Families of conditions in the TOML of a recipe: each is the recipe with some keys changed."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

SECTIONS = ("pose", "target", "environment", "exposure")


def fill_families(table: dict[str, Any]) -> None:
    """Complete each of a recipe's `[[families]]`, in place, with the keys of the recipe's sections that it leaves out.

    Raises:
        ValueError: they are not an array of tables.
    """
    families = table.get("families", [])
    if not isinstance(families, list) or not all(isinstance(family, dict) for family in families):
        raise ValueError("families: must be tables, each begun by [[families]]")
    for family in families:
        for section in SECTIONS:
            common, own = table.get(section, {}), family.get(section, {})
            if isinstance(common, dict) and isinstance(own, dict):
                family[section] = {**deepcopy(common), **own}
