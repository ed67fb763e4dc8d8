"""Work done ahead by threads, handed over in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def prefetch_map(do: Callable[[Task], Result], tasks: Iterable[Task], threads: int, ahead: int) -> Generator[Result]:
    """The results of tasks in the order of the tasks, of which at most `ahead` are begun before they are asked for.

    Raises:
        Exception: that of a task, when its turn comes; those begun are finished, the others are not begun.
    """
    begun: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for task in tasks:
                begun.append(pool.submit(do, task))
                if len(begun) > ahead:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for future in begun:
                future.cancel()
