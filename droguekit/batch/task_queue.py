"""Waiting tasks in groups, so that a process that has made what a group shares also does the rest of the group."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable


def _one_group(_: int) -> int:
    return 0


class TaskQueue:
    """Waiting tasks, by groups in the order of their first tasks."""

    def __init__(self, indices: Iterable[int], group_of: Callable[[int], int] | None = None) -> None:
        """Take the tasks' indices, and the number of the group of each; without it they keep their order."""
        self._group_of = group_of or _one_group
        self._waiting: dict[int, deque[int]] = {}
        self._count = 0
        for index in indices:
            self.add(index)

    def __len__(self) -> int:
        """Number of waiting tasks."""
        return self._count

    def add(self, index: int) -> None:
        """Let a task wait behind the others of its group."""
        self._waiting.setdefault(self._group_of(index), deque()).append(index)
        self._count += 1

    def clear(self) -> None:
        """Forget all tasks."""
        self._waiting.clear()
        self._count = 0

    def in_rows(self) -> list[int]:
        """All waiting tasks, group by group."""
        return [index for tasks in self._waiting.values() for index in tasks]

    def take(self, before: int | None, held: Collection[int] = ()) -> tuple[int, int]:
        """Take a task for a process.

        Args:
            before: group of its last task; the next one is of the same if any is left.
            held: groups at which other processes are. They are left to these until no other group waits, and then
                shared, the one with the most tasks first.

        Returns:
            The task's index and its group.

        Raises:
            ValueError: no task waits.
        """
        if not self._count:
            raise ValueError("tasks: none waits")
        group = before
        if group is None or group not in self._waiting:
            group = next((each for each in self._waiting if each not in held), None)
        if group is None:
            group = max(self._waiting, key=lambda each: len(self._waiting[each]))
        tasks = self._waiting[group]
        index = tasks.popleft()
        if not tasks:
            del self._waiting[group]
        self._count -= 1
        return index, group
