"""Signals that end a command: Ctrl-C, SIGTERM from a scheduler, SIGHUP from a terminal that closes.

The first signal raises `Interrupted` at once, or at the end of a block that must not be left half done
(`uninterrupted`). Later signals are ignored, so that a second one does not break off the cleaning up.
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
    """How the process answers a signal now.

    Attributes:
        does: raise `Interrupted`, wait for the end of a block, or exit on the spot.
        waiting: the signal that waits, or None.
    """

    does: Literal["raise", "wait", "exit"] = "raise"
    waiting: int | None = None


@contextlib.contextmanager
def interruptible(program: str) -> Iterator[None]:
    """In this block signals raise `Interrupted`. Those that the process ignores from the start (`nohup`) do not.

    What is raised inside numba's compiler or dispatcher comes out as another error, and is raised anew.
    """
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
    except Exception as error:
        if (stop := _behind(error)) is not None:
            raise stop from None
        raise
    finally:
        for number in heard:
            signal.signal(number, before[number])


def _behind(error: BaseException | None) -> Interrupted | None:
    """The signal behind an error of numba or of the interpreter. None: there is none, or the error is another one."""
    if not (isinstance(error, SystemError | RuntimeError) or type(error).__module__.startswith("numba")):
        return None
    while error is not None and not isinstance(error, Interrupted):
        error = error.__cause__ or error.__context__
    return error


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """In this block signals wait. `Interrupted` is raised at its end."""
    before, _Now.does = _Now.does, "wait"
    try:
        yield
    finally:
        _Now.does, number, _Now.waiting = before, _Now.waiting, None
        if number is not None:
            raise Interrupted(number)


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """In this block a signal ends the process on the spot.

    Nothing has begun yet, and some modules crash if an exception is raised while they are imported.
    """
    before, _Now.does = _Now.does, "exit"
    try:
        yield
    finally:
        _Now.does = before
