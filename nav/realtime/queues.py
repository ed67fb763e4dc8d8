"""From one thread to the next: the newest only, or one at a time."""

from __future__ import annotations

from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar("Item")


class NewestFirst(Generic[Item]):
    """A place for one numbered thing; a newer one takes the place of what waits there, which then is late."""

    def __init__(self) -> None:
        """Empty and open."""
        self._changed = Condition()
        self._late: list[int] = []
        self._late_after: list[int] = []
        self._waiting: tuple[int, Item] | None = None
        self._is_closed = False

    def put(self, number: int, item: Item) -> None:
        """Bring the newest thing."""
        with self._changed:
            if self._waiting is not None:
                self._late.append(self._waiting[0])
            self._late += self._late_after
            self._late_after = []
            self._waiting = number, item
            self._changed.notify_all()

    def skip(self, number: int) -> None:
        """Name one, newer than all before, that is not brought: the next one came too early for it."""
        with self._changed:
            (self._late if self._waiting is None else self._late_after).append(number)

    def take(self) -> tuple[tuple[int, ...], Item] | None:
        """Wait for a thing.

        Returns:
            Numbers of those that are late and older than it, ascending and each told once, and the newest; None when
            there will be no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._is_closed)
            if self._waiting is None:
                return None
            (_, item), late = self._waiting, tuple(self._late)
            self._waiting, self._late, self._late_after = None, self._late_after, []
            return late, item

    def close(self) -> None:
        """Nothing more is brought."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class Handover(Generic[Item]):
    """A place for one thing; whoever brings the next one waits until it is free."""

    def __init__(self) -> None:
        """Empty and open."""
        self._changed = Condition()
        self._waiting: list[Item] = []
        self._is_closed = False

    def wait_free(self) -> bool:
        """Wait until there is room; False when it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting or self._is_closed)
            return not self._is_closed

    def put(self, item: Item) -> None:
        """Bring a thing, once the place is free."""
        with self._changed:
            self._waiting.append(item)
            self._changed.notify_all()

    def take(self) -> Item | None:
        """Wait for a thing; None when there will be no more."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            item = self._waiting.pop() if self._waiting else None
            self._changed.notify_all()
            return item

    def close(self) -> None:
        """Nothing more is brought."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
