"""Sections that are objects: tasks, barriers, priors and bounds that were made in Python.

`fsid.observe` and `fsid.check` take an object in place of a section of the file. It is wrapped in a record that answers
what the commands ask a section. Files cannot hold objects: config.yaml shows an object as it prints (`kind: python`).
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from textwrap import shorten
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import field_serializer

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import Units
from torchfsid.config.tasks import _Task
from torchfsid.errors import ConfigError, InputError, one_line

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from torchfsid.sets.feasible_set import FeasibleSet

Handler = Callable[[Any], Any]

UNITS = {"goal": "m", "centre": "m", "offset": "m", "velocity": "m/s"}
"""Units of theta by the names of its entries, without the axis."""

NO_PLACES = ("offset", "velocity")
"""Names of what is no place."""

GIVEN = "python"
"""The kind of a section that is an object."""


def is_object(value: Any) -> bool:
    """Is this neither a section nor anything else that a file can hold?"""
    return value is not None and not isinstance(value, Strict | Mapping | str | int | float | list | tuple | date)


class _Given(Strict):
    """An object. Its text stands in for it in a file.

    Attributes:
        object: the object.
        suspects: the key to look at where it contradicts a log.
    """

    object: Any
    suspects: ClassVar[tuple[str, ...]] = ("object",)

    @field_serializer("object")
    def _as_text(self, value: Any) -> str:
        return shorten(one_line(repr(value)), 200, placeholder=" ...")


class GivenTask(_Given, _Task):
    """A task (`robots.tasks.Task`)."""

    kind: Literal["python"] = GIVEN

    def parameters(self, dimension: int) -> int:
        return len(self.object.parameter_names)

    @property
    def dimensions(self) -> tuple[int, ...]:
        """What the task says. An own task that says nothing may be of either."""
        said = getattr(self.object, "dimension", None)
        return (2, 3) if said is None else (said,)

    @property
    def unit(self) -> str:
        """The unit of theta, as far as the names of its entries tell it."""
        return UNITS.get(self._what, "")

    @property
    def is_place(self) -> bool:
        return self._what not in NO_PLACES

    @property
    def _what(self) -> str:
        return self.object.parameter_names[0].rpartition("_")[0]

    @property
    def is_clipped(self) -> bool:
        return getattr(self.object, "saturation", None) is not None

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Any:
        """The task itself."""
        return self.object


class GivenBarrier(_Given):
    """A barrier (`robots.barriers.Barrier`), or an `UnknownAvoidance`."""

    kind: Literal["python"] = GIVEN
    narrowed: ClassVar[Units] = {}

    @property
    def is_unknown(self) -> bool:
        """Only a barrier with known parameters can be called."""
        return not callable(self.object)

    @property
    def is_second_order(self) -> bool:
        return getattr(self.object, "order", 1) == 2

    @property
    def uncertain(self) -> bool:
        return bool(getattr(self.object, "uncertain", False))

    @property
    def dimension(self) -> None:
        """What is in the object is not known here."""
        return None

    @property
    def uses_radius(self) -> bool:
        return getattr(self.object, "margin", None) is not None

    @property
    def neighbour_velocity(self) -> str:
        """What the barrier says. It may use the current ones if it says nothing."""
        return getattr(self.object, "neighbour_velocity", None) or "current"

    def require_radii(self, radius: Sequence[float] | None) -> None:
        """Check that the log has the radii that the rows need.

        Raises:
            ConfigError: the barrier has a margin, and there are none.
        """
        if self.uses_radius and radius is None:
            raise ConfigError("barriers: a margin needs the radii, but the log has none (column radius, bag.radius)")

    def build(self, bodies: Sequence[str]) -> Any:
        """The barrier itself."""
        return self.object


class GivenPrior(_Given):
    """A `FeasibleSet`: one for all robots, or a batch with one for each."""

    kind: Literal["python"] = GIVEN

    @property
    def lower(self) -> tuple[float, ...]:
        """The least entries of theta in all sets."""
        return tuple(self.corners(0)[0].reshape(-1, self.object.dim).amin(0).tolist())

    @property
    def upper(self) -> tuple[float, ...]:
        """The largest entries of theta in all sets."""
        return tuple(self.corners(0)[1].reshape(-1, self.object.dim).amax(0).tolist())

    def build(self, robots: int) -> FeasibleSet:
        """The prior set of each robot.

        Raises:
            ConfigError: there are sets for another number of robots.
        """
        import torch

        if not self.object.batch_shape:
            return self.object[None][torch.zeros(robots, dtype=torch.long)]
        if self.object.batch_shape != (robots,):
            raise ConfigError(f"prior: expected one set, or one for each of {robots} robots, got {len(self.object)}")
        return self.object

    def corners(self, robots: int) -> tuple[Float[Tensor, "*robots p"], Float[Tensor, "*robots p"]]:
        """The corners of the boxes around the sets, once for each robot. With 0 robots they are those of the object."""
        vertices = (self.build(robots) if robots else self.object).vertices().detach()
        return vertices.amin(-2), vertices.amax(-2)


def a_task(value: Any, section: Handler) -> Any:
    """A section of a task, or a task, as a section."""
    if is_object(value):
        from torchfsid.robots.arguments import require_task

        _check(require_task, value)
        return GivenTask(object=value)
    return value if isinstance(value, GivenTask) else section(value)


def a_barrier(value: Any, section: Handler) -> Any:
    """A section of a barrier, or a barrier, as a section."""
    if is_object(value):
        from torchfsid.robots.arguments import require_barriers

        _check(lambda barrier: require_barriers([barrier]), value)
        return GivenBarrier(object=value)
    return value if isinstance(value, GivenBarrier) else section(value)


def a_prior(value: Any, section: Handler) -> Any:
    """A section of a prior, or a `FeasibleSet`, as a section."""
    if is_object(value):
        from torchfsid.sets.feasible_set import FeasibleSet

        if not isinstance(value, FeasibleSet) or len(value.batch_shape) > 1 or value.any_empty:
            raise wrong(f"expected {{lower: [..], upper: [..]}} or a FeasibleSet, got {reprlib.repr(value)}")
        return GivenPrior(object=value)
    return value if isinstance(value, GivenPrior) else section(value)


def _check(check: Handler, value: Any) -> None:
    """Turn the refusal of an argument into that of a section."""
    try:
        check(value)
    except InputError as error:
        raise wrong(f"expected a section or {error.expected}, got {error.actual}") from error


def bounds(noise: Any, dynamics: Any) -> dict[str, Any]:
    """The section `noise` of a `NoiseBound`. Velocities before a sample and those of neighbours share a bound there.

    Raises:
        PydanticCustomError: it is no such bound, or has one for each robot.
    """
    import torch

    from torchfsid.robots.bounds import NoiseBound

    if not isinstance(noise, NoiseBound) or any(torch.as_tensor(bound).ndim for bound in vars(noise).values()):
        expected = "expected {velocity: ..} or a NoiseBound with a bound for all robots"
        raise wrong(f"{expected}, got {reprlib.repr(noise)}", "noise")
    given = {name: float(bound) for name, bound in vars(noise).items()}
    slack = {} if given["slack"] == given["velocity"] else {"slack": given["slack"]}
    others = {"position": given["position"], "neighbour_velocity": max(given["neighbour_velocity"], given["arrival"])}
    if dynamics != "double_integrator":
        return {"velocity": given["velocity"], **slack, **others}
    second = {"acceleration": given["velocity"], "velocity": given["arrival"]}
    return {**second, **slack, **others, "neighbour_acceleration": given["neighbour_acceleration"]}
