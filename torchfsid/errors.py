"""The exceptions that torchfsid raises on purpose.

A mistake of the caller raises an exception that says what was expected and what was given. A failure of the data (an
empty set, an infeasible QP, a missing robot) is a value, a status or a mask. So one bad item never stops a batch.
"""


class FsidError(Exception):
    """Base class of all exceptions that torchfsid raises on purpose."""


class InputError(FsidError, ValueError):
    """An argument does not fit the function. The message names it, says what was expected and what was given."""

    def __init__(self, argument: str, expected: str, actual: object):
        super().__init__(f"{argument}: expected {expected}, got {actual}")
        self.argument, self.expected, self.actual = argument, expected, actual


class ConfigError(FsidError):
    """A configuration is wrong. The message names the key's path, what was expected and what was given."""


class LogError(FsidError):
    """A log cannot be read. The message names the file, the line and what is wrong there."""


class InconsistentError(FsidError):
    """No parameter explains the measurements, and the observer was told to raise an exception in this case.

    Attributes:
        robot: index of the robot.
        t: time [s].
        rows: the half-spaces that contradict each other, each as (time, source), as in `Event`.
    """

    def __init__(self, robot: int, t: float, rows: tuple[tuple[float, int], ...]):
        named = ", ".join(dict.fromkeys(f"({time:.15g}, {source})" for time, source in rows))
        super().__init__(
            f"robot {robot} at t = {t:.15g} s: no parameter explains the measurements; "
            f"these rows contradict each other, as (time, source): {named}"
        )
        self.robot, self.t, self.rows = robot, t, rows


class BarrierError(FsidError, AssertionError):
    """A barrier breaks promises of its protocol. The message names the checks, the rows and the numbers."""


class SolverError(FsidError):
    """A third-party solver failed; the original exception is the cause."""


class FigureError(FsidError):
    """A figure could not be drawn. The message names the missing or damaged file, or quotes the plotting library."""


def one_line(message: object) -> str:
    """A foreign message on one printable line. An exception without a message gives the name of its class."""
    text = " ".join(str(message).split()) or type(message).__name__
    return "".join(character if character.isprintable() else "?" for character in text)
