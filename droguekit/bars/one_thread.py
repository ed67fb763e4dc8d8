"""Linear algebra on one thread: with more, equal inputs differ in the last bits from call to call, and time is lost."""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def one_thread() -> AbstractContextManager[object]:
    """Hold the linear algebra of numpy and scipy to one thread; what was set before returns at the end."""
    limits: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limits
