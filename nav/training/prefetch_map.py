"""A map over tasks that threads compute ahead of their consumer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def prefetch_map(
    function: Callable[[Task], Result], tasks: Iterable[Task], threads: int, ahead: int
) -> Generator[Result]:
    """Yield the results of tasks in their order; threads begin at most `ahead` tasks before their results are needed.

    Raises:
        Exception: that of a task, at its turn; tasks that have begun are finished, others are not begun.
    """
    begun: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for task in tasks:
                begun.append(pool.submit(function, task))
                if len(begun) > ahead:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for future in begun:
                future.cancel()
