"""The status of a set, a programme, a filter or an observer, one for each item. This file needs no torch."""

from __future__ import annotations

from enum import IntEnum
from typing import Any


class Status(IntEnum):
    """What became of an item: a word has one number wherever it is used, and OK is 0 everywhere.

        sets         OK (not empty), UNDECIDED, EMPTY
        programmes   OK, EMPTY, UNBOUNDED, DEGENERATE, UNDEFINED, UNSOLVED       all but OK and DEGENERATE: no answer
        filters      OK, PREDICTED, REPAIRED, FAILED
        hybrids      OK, EUCLIDEAN, CENTROID
        observers    OK, ALARM, INCONSISTENT                                     in this order, the worst so far

    Results hold tensors of these numbers. `Status.names` puts them into words, as in the files: "ok", "alarm" ...
    """

    OK = 0

    ALARM = 1
    """A hard row was violated by more than its bound. Cause: the model is wrong or a bound is too small.
    Remedy: check the barriers, or declare larger bounds."""
    INCONSISTENT = 2
    """An intersection was empty: no parameter explains the measurements. Cause: the model, the prior or a bound is
    wrong, or the robot changed its task. Remedy: check them, or let the observer reset its sets."""

    UNDECIDED = 3
    """Half-spaces touch within round-off, so that emptiness cannot be decided. An outer set is kept."""
    EMPTY = 4
    """No point satisfies the rows. The radius of the inscribed ball is then minus the depth of the contradiction: the
    least distance by which all rows have to be moved outward. It is -inf if a row 0.z <= b has b < 0."""

    UNBOUNDED = 5
    """Inscribed ball only. There is no largest ball (radius inf), or the centres of the largest balls are unbounded."""
    DEGENERATE = 6
    """Inscribed ball only. The radius is zero within round-off: the set has no interior."""
    UNDEFINED = 7
    """A row or the point is NaN or infinite, or the metric is not positive definite."""
    UNSOLVED = 8
    """No answer could be verified, not even one in rational arithmetic. Cause: the numbers have very different sizes.
    Remedy: shift the set to the origin and choose units in which its width is about 1."""

    PREDICTED = 9
    """The measurement says nothing about theta: the robot was not seen, or its motion up to now is not known. The first
    measurement always has this status."""
    REPAIRED = 10
    """The covariance had lost definiteness and was repaired."""
    FAILED = 11
    """The filter's numbers overflowed, or its covariance could not be factored. It starts again from its prior.
    Cause: time step, spread of the prior and position noise are out of proportion (milliseconds read as seconds, say).
    Remedy: correct the units of time and length, choose a smaller spread or a larger position noise.
    The set does not depend on the filter."""

    EUCLIDEAN = 12
    """The estimate was projected onto its set in the Euclidean norm, not in the metric of the filter's covariance: that
    was not finite, or not positive definite."""
    CENTROID = 13
    """The centroid of the set replaces the filter's estimate, which was not finite, or too far away to have a nearest
    point."""

    def __str__(self) -> str:
        return self.name.lower()

    def __format__(self, specification: str) -> str:
        return format(str(self), specification)

    @classmethod
    def names(cls, statuses: Any) -> Any:
        """The words for a tensor, an array or nested lists of statuses: nested lists, or one word for one number."""
        values = statuses.tolist() if hasattr(statuses, "tolist") else statuses
        return [cls.names(value) for value in values] if isinstance(values, list | tuple) else str(cls(values))
