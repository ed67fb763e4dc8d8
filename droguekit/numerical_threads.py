"""Numerical libraries on one thread: with more, equal inputs differ in the last bits from call to call."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


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


@contextmanager
def one_thread_in_new_processes() -> Iterator[None]:
    """Let a process that starts meanwhile use one thread; libraries read these variables when they load."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
