"""Numerical libraries on one thread: with more, equal inputs differ in the last bits from call to call."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold OpenCV and the linear algebra of numpy and scipy to one thread; what was set before returns at the end.

    Matrices and pictures are small here: libraries that spread them over threads take twice the time and more. Linear
    algebra that is loaded only later is not held.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)
