from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress

import pytest

from droguekit.workflows.rendering import delay_interrupts


@pytest.fixture(autouse=True)
def default_handler() -> Iterator[None]:
    """The handlers of the command, whatever a library imported by an earlier test has put in their place."""
    numbers = signal.SIGINT, signal.SIGTERM
    before = [signal.signal(number, signal.default_int_handler) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_somebody_would_swallow_comes_after_the_block(number: signal.Signals) -> None:
    swallowed = reached = False
    with pytest.raises(KeyboardInterrupt):
        with delay_interrupts(), suppress(BaseException):
            signal.raise_signal(number)
            swallowed = True
        reached = True
    assert swallowed and not reached
    assert signal.getsignal(number) is signal.default_int_handler


def test_the_handler_of_before_hears_it_once_after_the_block() -> None:
    heard: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    with delay_interrupts():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert heard == []
    assert heard == [signal.SIGINT]


def test_without_an_interrupt_nothing_happens() -> None:
    with delay_interrupts():
        pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
