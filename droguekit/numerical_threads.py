"""Restrict numerical libraries to one thread: with several, equal inputs give results that differ in the last bits."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict OpenCV and the linear algebra of numpy and scipy to one thread, and restore the setting at the end.

    Matrices and pictures are small here, so that several threads would take at least twice the time. Libraries that
    are loaded only inside the block are not restricted.
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
    """Restrict processes that start meanwhile to one thread; libraries read these variables when they load."""
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
