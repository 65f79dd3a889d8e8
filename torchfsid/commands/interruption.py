"""Signals that ask a command to end: Ctrl-C, SIGTERM from a scheduler, SIGHUP from a terminal that closes.

The first one raises `Interrupted` where the command is, or as soon as what must not be left half done is done. Later
ones are ignored, so that nobody who asks twice gets less.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(KeyboardInterrupt):
    """A signal asks the command to end."""

    def __init__(self, number: int):
        super().__init__()
        self.number = number

    def __str__(self) -> str:
        return "interrupted" if self.number == signal.SIGINT else f"stopped by {signal.Signals(self.number).name}"


class _Pending:
    """Signals come to the process: so this is of the process too."""

    held = False
    number: int | None = None


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Signals raise `Interrupted` in here. Those that the process was started to ignore (`nohup`) stay ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    heard = [number for number in SIGNALS if before[number] is not signal.SIG_IGN]

    def interrupt(number: int, frame: FrameType | None) -> None:
        for other in heard:
            signal.signal(other, signal.SIG_IGN)
        if not _Pending.held:
            raise Interrupted(number)
        _Pending.number = number

    for number in heard:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """A signal raises `Interrupted` only after this."""
    _Pending.held = True
    try:
        yield
    finally:
        _Pending.held, number, _Pending.number = False, _Pending.number, None
        if number is not None:
            raise Interrupted(number)
