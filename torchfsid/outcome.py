"""What came of something, item by item: the answers of sets, programmes, filters and observers. No torch here."""

from __future__ import annotations

from enum import IntEnum


class Outcome(IntEnum):
    """What an intersection came to: a three-way answer, so that round-off is never taken for knowledge."""

    NONEMPTY = 0
    UNDECIDED = 1
    """The sets touch within round-off: emptiness cannot be decided, and an outer set is kept."""
    EMPTY = 2


class ProgrammeStatus(IntEnum):
    """What became of one item of a batch; where there is no answer, its value is NaN and its gradient zero."""

    OK = 0
    EMPTY = 1
    """No point satisfies the rows. The inscribed ball has a negative radius then: minus the depth, the least distance
    by which all rows have to be moved outward (-inf: a row 0.z <= b with b < 0)."""
    UNBOUNDED = 2
    """Of the inscribed ball: there is no largest one (radius inf), or its centre can roll away to infinity."""
    DEGENERATE = 3
    """Of the inscribed ball: its radius is zero within round-off, the set has no interior."""
    UNDEFINED = 4
    """A row or the point is NaN or infinite, or the metric is not positive definite."""
    UNSOLVED = 5
    """No answer could be verified, not even one in rational arithmetic: numbers of very different sizes meet.
    Ask nearer to the origin and in other units (shifted and scaled until the set's width is about 1)."""


class FilterStatus(IntEnum):
    """What the last measurement did to a robot's filter."""

    OK = 0
    PREDICTED = 1
    """It says nothing about theta: the robot was not seen, or the motion up to it is not known (as at first sight)."""
    REPAIRED = 2
    """The covariance had lost definiteness and was repaired."""
    FAILED = 3
    """Its numbers overflowed, or its covariance could not be factored: time step, spread of the prior and position
    noise are too far out of proportion (milliseconds read as seconds, say). It starts again from its prior. Remedy: the
    units of time and length, a smaller spread, more position noise. The set does not depend on it."""


class HybridStatus(IntEnum):
    """How the hybrid observer brought a robot's estimate into its set."""

    OK = 0
    """Nearest point in the metric of the filter's covariance."""
    EUCLIDEAN = 1
    """Nearest point in the Euclidean norm: the covariance was not finite, or not positive definite."""
    CENTROID = 2
    """The centroid of the set: the filter's estimate was not finite, or too far away to have a nearest point."""


class Status(IntEnum):
    """Can a robot's set be trusted?"""

    OK = 0
    ALARM = 1
    """A hard row was violated by more than its bound: the model or the bounds are wrong."""
    INCONSISTENT = 2
    """An intersection came out empty: no parameter explains the measurements."""
