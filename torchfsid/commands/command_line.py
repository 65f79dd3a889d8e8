"""The common scaffold of the command lines: arguments, exit codes, one line per error, signals.

    0             done
    2             a mistake of the caller: nothing was written
    1             it failed later, for example on a full disk: files written before are whole
    128 + number  ended by a signal: Ctrl-C (130), SIGTERM (143), SIGHUP (129)

This module imports nothing slow. A command that imports the rest inside `execute` answers Ctrl-C at once.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Callable
from typing import NoReturn

from torchfsid.commands.interruption import Interrupted, interruptible
from torchfsid.commands.results_folder import ResultsFolder
from torchfsid.errors import FsidError, one_line

DONE, FAILURE, USAGE_ERROR = 0, 1, 2


class Parser(argparse.ArgumentParser):
    """A parser that reports a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the mistake in one line, and exit with code 2."""
        self.exit(USAGE_ERROR, f"{self.prog}: {message}\n")


def add_overrides(command: argparse.ArgumentParser) -> None:
    """Add the option `--set a.b=value`, whose values go to `apply_overrides`."""
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="A.B=VALUE",
        help="replace a key of the configuration by a YAML value; entries of lists are counted from 0 "
        "(barriers.0.class_k.gain=2); may be given several times",
    )


def execute(
    program: str,
    action: Callable[[], object],
    folder: ResultsFolder | None = None,
    left: str = "what is done so far is in {folder}",
) -> int:
    """Run a command and return its exit code. An error is one line on stderr.

    Args:
        program: the name at the start of that line.
        action: the command. It imports what it needs itself (`interruption.importing`), slow modules last.
        folder: the results folder. It is released at the end.
        left: what to say if the command is interrupted after it began to write.
    """

    def has_begun() -> bool:
        return folder is not None and folder.claimed

    code, message = DONE, ""
    for name in ("stdout", "stderr"):  # None where the shell has closed it
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    # The message is printed below the `except` clauses. By then the frames of the exception are gone, and with them a
    # progress line.
    try:
        with interruptible(program):
            action()
            _flush()
    except FsidError as error:
        code, message = FAILURE if has_begun() else USAGE_ERROR, str(error)
    except OSError as error:
        code = FAILURE if has_begun() or error.filename is None else USAGE_ERROR
        message = f"{error.filename or 'standard output'}: {error.strerror or one_line(error)}"
    except MemoryError:
        code, message = FAILURE, "not enough memory"
    except KeyboardInterrupt as stop:
        number = stop.number if isinstance(stop, Interrupted) else int(signal.SIGINT)
        code, message = 128 + number, str(Interrupted(number))
        if folder is not None and has_begun():
            message += f"; {left.format(folder=folder.path)}"
    finally:
        if folder is not None:
            folder.release()
    if message:
        with contextlib.suppress(OSError):
            print(f"{program}: {message}", file=sys.stderr)
    return code


def use_one_thread() -> None:
    """Let torch use one thread. The tensors here are small, and more threads would only wait for each other."""
    import torch

    torch.set_num_threads(1)


def _flush() -> None:
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has seen enough, as `head` does
        silence(sys.stdout.fileno())


def silence(descriptor: int) -> None:
    """Redirect a closed pipe to nowhere, so that what is still to be written does not fail again at exit."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
