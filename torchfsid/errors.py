"""What can go wrong, and whose fault it is.

The caller's mistakes raise here, at the boundary, with what was expected and what came. The failures of data
(an empty set, an infeasible QP, a missing robot) are values: statuses and masks, so one bad item never kills a batch.
"""


class FsidError(Exception):
    """Root of everything torchfsid raises on purpose."""


class InputError(FsidError, ValueError):
    """An argument is not what the function takes: its name, what was expected, what came."""

    def __init__(self, argument: str, expected: str, actual: object):
        super().__init__(f"{argument}: expected {expected}, got {actual}")
        self.argument, self.expected, self.actual = argument, expected, actual


class ConfigError(FsidError):
    """A configuration is wrong: the path of the key, what was expected, what came."""


class LogError(FsidError):
    """A log cannot be read as one: the file, the line, what is wrong there."""


class InconsistentError(FsidError):
    """No parameter explains the measurements, and the observer was told to raise then."""


class SolverError(FsidError):
    """A third-party solver failed; the original exception is the cause."""


class FigureError(FsidError):
    """A figure could not be drawn: the file that is missing or damaged, or what the plotting library said."""


def one_line(message: object) -> str:
    """What somebody else says, on one printable line; an exception without words is named."""
    text = " ".join(str(message).split()) or type(message).__name__
    return "".join(character if character.isprintable() else "?" for character in text)
