"""Fixtures of tiny datasets, see `tests/support/batch_datasets.py`."""

from __future__ import annotations

from tests.support.batch_datasets import (  # noqa: F401
    analytic_dataset,
    quick_dataset,
    tiny_dataset,
    troubled,
    troubled_site,
)
