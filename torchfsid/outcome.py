"""Outcomes and statuses of sets, programmes, filters and observers, one for each item. This file needs no torch."""

from __future__ import annotations

from enum import IntEnum


class Outcome(IntEnum):
    """Is an intersection empty? There are three answers, because round-off may leave it undecided."""

    NONEMPTY = 0
    UNDECIDED = 1
    """The sets touch within round-off, so that emptiness cannot be decided. An outer set is kept."""
    EMPTY = 2


class ProgrammeStatus(IntEnum):
    """The status of a programme for one item of a batch. Without an answer, its value is NaN and its gradient zero."""

    OK = 0
    EMPTY = 1
    """No point satisfies the rows. The radius of the inscribed ball is then minus the depth of the contradiction: the
    least distance by which all rows have to be moved outward. It is -inf if a row 0.z <= b has b < 0."""
    UNBOUNDED = 2
    """Inscribed ball only. There is no largest ball (radius inf), or the centres of the largest balls are unbounded."""
    DEGENERATE = 3
    """Inscribed ball only. The radius is zero within round-off: the set has no interior."""
    UNDEFINED = 4
    """A row or the point is NaN or infinite, or the metric is not positive definite."""
    UNSOLVED = 5
    """No answer could be verified, not even one in rational arithmetic. Cause: the numbers have very different sizes.
    Remedy: shift the set to the origin and choose units in which its width is about 1."""


class FilterStatus(IntEnum):
    """The status of a robot's filter after the last measurement."""

    OK = 0
    PREDICTED = 1
    """The measurement says nothing about theta: the robot was not seen, or its motion up to now is not known. The first
    measurement always has this status."""
    REPAIRED = 2
    """The covariance had lost definiteness and was repaired."""
    FAILED = 3
    """The filter's numbers overflowed, or its covariance could not be factored. It starts again from its prior.
    Cause: time step, spread of the prior and position noise are out of proportion (milliseconds read as seconds, say).
    Remedy: correct the units of time and length, choose a smaller spread or a larger position noise.
    The set does not depend on the filter."""


class HybridStatus(IntEnum):
    """How the hybrid observer projected a robot's estimate onto its set."""

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
    """A hard row was violated by more than its bound. Cause: the model is wrong or a bound is too small.
    Remedy: check the barriers, or declare larger bounds."""
    INCONSISTENT = 2
    """An intersection was empty: no parameter explains the measurements. Cause: the model, the prior or a bound is
    wrong, or the robot changed its task. Remedy: check them, or let the observer reset its sets."""
