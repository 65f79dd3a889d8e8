"""Signals that ask a command to end: Ctrl-C, SIGTERM from a scheduler, SIGHUP from a terminal that closes.

The first one raises `Interrupted` where the command is, or as soon as what must not be left half done is done. Later
ones are ignored, so that nobody who asks twice gets less.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Literal

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(KeyboardInterrupt):
    """A signal asks the command to end."""

    def __init__(self, number: int):
        super().__init__()
        self.number = number

    def __str__(self) -> str:
        return "interrupted" if self.number == signal.SIGINT else f"stopped by {signal.Signals(self.number).name}"


class _Now:
    """What a signal does now, and which one waits. Signals come to the process: so this is of the process too."""

    does: Literal["raise", "wait", "exit"] = "raise"
    waiting: int | None = None


@contextlib.contextmanager
def interruptible(program: str) -> Iterator[None]:
    """Signals raise `Interrupted` in here. Those that the process was started to ignore (`nohup`) stay ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    heard = [number for number in SIGNALS if before[number] is not signal.SIG_IGN]

    def interrupt(number: int, frame: FrameType | None) -> None:
        for other in heard:
            signal.signal(other, signal.SIG_IGN)
        if _Now.does == "exit":
            os.write(2, f"{program}: {Interrupted(number)}\n".encode())
            os._exit(128 + number)
        if _Now.does == "raise":
            raise Interrupted(number)
        _Now.waiting = number

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
    before, _Now.does = _Now.does, "wait"
    try:
        yield
    finally:
        _Now.does, number, _Now.waiting = before, _Now.waiting, None
        if number is not None:
            raise Interrupted(number)


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """A signal ends the process on the spot. Nothing is begun yet, and some modules crash where an exception meets them
    while they are imported."""
    before, _Now.does = _Now.does, "exit"
    try:
        yield
    finally:
        _Now.does = before
