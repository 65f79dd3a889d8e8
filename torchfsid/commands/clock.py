"""Times as people read them: as logged, or from the first sample on where stamps count from 1970."""

from __future__ import annotations

from dataclasses import dataclass

EPOCH = 1e8
"""Times beyond this [s] are stamps since 1970: no clock that starts with the robots runs for three years."""


@dataclass(frozen=True)
class Clock:
    """Times of one log as text. Files keep the times of the log.

    Attributes:
        start: what is subtracted from them [s].
    """

    start: float = 0.0

    @classmethod
    def of(cls, first: float) -> Clock:
        """The clock of a log whose first sample has this time [s]."""
        return cls(first if abs(first) > EPOCH else 0.0)

    def __call__(self, t: float) -> str:
        """A time of the log as text."""
        return seconds(t - self.start)

    def sentence(self) -> list[str]:
        """What has to be said of these times: nothing where they are those of the log."""
        if not self.start:
            return []
        return [f"Times shown here count from the first sample, t0 = {self.start:.15g} s; files have those of the log."]


def seconds(t: float) -> str:
    """A time [s] as text, rounded to 0.1 ms. This holds for times since 1970, too."""
    return f"{round(t, 4):.15g} s"
