"""Fixtures of tiny datasets, see `tests/support/batch_datasets.py`."""

from __future__ import annotations

from tests.support.batch_datasets import (  # noqa: F401
    analytic_dataset,
    analytic_recipe,
    hashes,
    make,
    quick_dataset,
    quick_recipe,
    tiny_dataset,
    tiny_recipe,
    troubled,
    troubled_site,
)
