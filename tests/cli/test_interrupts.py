from __future__ import annotations

import signal
from contextlib import suppress

import pytest

from droguekit.cli.interrupts import interrupts_wait


def test_an_interrupt_that_somebody_would_swallow_comes_after_the_block():
    swallowed = reached = False
    with pytest.raises(KeyboardInterrupt):
        with interrupts_wait(), suppress(BaseException):
            signal.raise_signal(signal.SIGINT)
            swallowed = True
        reached = True
    assert swallowed and not reached
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_an_interrupt_nothing_happens():
    before = signal.getsignal(signal.SIGINT)
    with interrupts_wait():
        pass
    assert signal.getsignal(signal.SIGINT) is before
