"""The configuration file of `torchfsid observe` and `torchfsid check`.

PyTorch is imported only when something is built, so that a wrong file is refused at once. The sections are in modules
of their own (`tasks`, `barriers`, `observers`), because other files use them too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator, Field, SerializeAsAny, Tag, WrapValidator, model_validator

from torchfsid.config.avoidance import AvoidanceConfig
from torchfsid.config.bags import BagConfig
from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.bodies import UnicycleConfig
from torchfsid.config.dimensions import dimensions_of, require_one_dimension
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.given import GIVEN, GivenBarrier, GivenTask, a_barrier, a_prior, a_task, bounds, is_object
from torchfsid.config.motion_capture import LogConfig
from torchfsid.config.observers import AccelerationNoiseConfig, ObservedNoiseConfig, PriorConfig, UkfConfig
from torchfsid.config.quantities import BodyName, Positive, Vector, require_body
from torchfsid.config.tasks import TaskConfig
from torchfsid.config.unknown_numbers import UnknownNumber, unknown_numbers
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torchfsid.observers.hybrid import HybridObserver
    from torchfsid.observers.safety import SafetyObserver
    from torchfsid.observers.set_membership import SetMembershipObserver
    from torchfsid.robots.barriers import Barrier
    from torchfsid.robots.tasks import Task
    from torchfsid.robots.unknown_avoidance import UnknownAvoidance


def _choice(value: Any) -> str:
    return "<false>" if value is False else "<section>"


def _driven_by(value: Any) -> str:
    accelerates = "acceleration" in value if isinstance(value, Mapping) else hasattr(value, "acceleration")
    return "<acceleration>" if accelerates else "<velocity>"


AnyNoiseConfig = Annotated[
    Annotated[ObservedNoiseConfig, Tag("<velocity>")] | Annotated[AccelerationNoiseConfig, Tag("<acceleration>")],
    Discriminator(_driven_by),
]
"""`noise: {acceleration: ..}` is for robots that are driven by accelerations."""


OptionalUkfConfig = Annotated[
    Annotated[UkfConfig, Tag("<section>")] | Annotated[Literal[False], Tag("<false>")], Discriminator(_choice)
]
"""`ukf: false` leaves the filter out, and with it the hybrid."""


Dynamics = Literal["single_integrator", "double_integrator"]


class ObserveConfig(Strict):
    """The file of `torchfsid observe`: the declared model, the prior and the bounds on errors.

    In Python, objects may take the place of task, barriers, prior and noise (`config.given`).

    Attributes:
        task: the task, whose parameter theta is inferred.
        barriers: the barriers, in the order of their rows.
        prior: the prior set of theta. The number of its entries says whether robots are in the plane or in space.
        noise: bounds on the errors of the log.
        set: which set is intersected over time.
        active_tolerance: distance of the control from a row's boundary below which the row counts as active [m/s] (G.,
            Eqs. (11), (12), (17)).
        dynamics: robots that are driven by velocities, or by accelerations (`double_integrator`).
        velocity: take controls from the log (`logged`), or from differences (`differentiated`): velocities from those
            of positions, accelerations from those of velocities. `windows` reads means over windows of positions, whose
            errors are `noise.position`. `noise.velocity` is then the error of the controllers alone.
        windows: lengths of these windows [s]. Default: those of 0.1, 0.25, 0.5 and 1 s that have two samples or more.
        body: unicycles, whose commands are recovered from their poses. Default: robots that move as commanded.
        obstacles: bodies of the log that are avoided but not inferred.
        on_inconsistent: what happens to a set when the intersection is empty: `hold` keeps it, `reset` starts again
            from the prior, `raise` ends the command.
        outliers: the number of samples per robot that may be left unexplained (`observers.outliers`).
        bag: where the bodies are in a ROS bag. Other logs ignore it.
        log: the form of a log of motion capture. Other logs have columns of their own.
        ukf: the unscented Kalman filter that runs beside the sets, or False for none. It is left out with the map
            `si_to_uni`, since positions then do not follow the commands.
        truth: the true theta of some robots, where it is known. It marks figures, tables and regions.json, and is used
            for nothing else: sets, bounds and statuses are the same without it.
    """

    task: Annotated[SerializeAsAny[TaskConfig], WrapValidator(a_task)]
    barriers: Annotated[
        tuple[Annotated[SerializeAsAny[BarrierConfig], WrapValidator(a_barrier)], ...], Field(min_length=1)
    ]
    prior: Annotated[SerializeAsAny[PriorConfig], WrapValidator(a_prior)]
    noise: AnyNoiseConfig
    set: Literal["inverse_optimal", "critical_region"] = "inverse_optimal"
    active_tolerance: Positive = 1e-3
    dynamics: Dynamics = "single_integrator"
    velocity: Literal["logged", "differentiated", "windows"] = "logged"
    windows: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    body: UnicycleConfig | None = None
    obstacles: tuple[BodyName, ...] = ()
    on_inconsistent: Literal["hold", "reset", "raise"] = "hold"
    outliers: Annotated[int, Field(strict=True, ge=0)] = 0
    bag: BagConfig | None = None
    log: LogConfig | None = None
    ukf: OptionalUkfConfig = UkfConfig()
    truth: dict[BodyName, Vector] | None = None

    @model_validator(mode="before")
    @classmethod
    def _takes_bounds(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not is_object(data.get("noise")):
            return data
        return {**data, "noise": bounds(data["noise"], data.get("dynamics"))}

    @model_validator(mode="after")
    def _fits_together(self) -> ObserveConfig:
        require_one_dimension(self.dimensions, self.barriers)
        for robot, theta in (self.truth or {}).items():
            if len(theta) != (expected := len(self.prior.lower)):
                raise wrong(f"task '{self.task.kind}' has {expected} parameters, got {len(theta)}", f"truth.{robot}")
        require_one_order(self.dynamics, self.task, self.barriers, self.noise)
        self._require_poses()
        unknown = [i for i, barrier in enumerate(self.barriers) if barrier.is_unknown]
        if len(unknown) > 1:
            raise wrong("one barrier may have unknown parameters, and another one has", f"barriers[{unknown[1]}]")
        if unknown and self.set == "critical_region":
            raise wrong("critical_region needs known safety parameters, take inverse_optimal", "set")
        if self.set == "critical_region" and self.task.is_clipped:
            raise wrong("critical_region knows no saturation or dead zone, take inverse_optimal", "set")
        if self.set == "critical_region" and any(barrier.uncertain for barrier in self.barriers):
            raise wrong("critical_region needs rows that are known exactly, take inverse_optimal", "set")
        for number in self.unknown_numbers[:1]:
            if self.set == "critical_region":
                raise wrong(f"critical_region needs a known {number.name}, take inverse_optimal", "set")
            if self.on_inconsistent == "reset":
                raise wrong(f"{number.name} can be narrowed only where robots keep their goals", "on_inconsistent")
            if self.noise.control == "auto":
                raise wrong(f"auto takes an error of {number.name} for noise, give a number or a known value", "noise")
        if self.noise.control == "auto" and self.on_inconsistent == "reset":
            raise wrong("auto takes a change of goal for noise, give a number or take on_inconsistent: hold", "noise")
        self._windows_fit()
        self._outliers_fit()
        return self

    def _windows_fit(self) -> None:
        if self.velocity != "windows":
            if self.windows is not None:
                raise wrong("expected velocity: windows beside it", "windows")
            return
        if self.dimension == 3:
            raise wrong("windows are for robots in the plane, take differentiated in space", "velocity")
        if self.is_second_order:
            raise wrong("windows are means of velocities, take differentiated with a double_integrator", "velocity")
        if self.set == "critical_region":
            raise wrong("windows need inverse_optimal", "set")
        if self.is_unknown or self.unknown_numbers:
            raise wrong("windows need known safety parameters and known numbers", "velocity")
        if self.on_inconsistent == "reset":
            raise wrong("a window may span a change of goal, take hold", "on_inconsistent")
        if self.noise.control == "auto":
            raise wrong("with windows it is the error of the controllers alone: expected a number", "noise.velocity")

    def _outliers_fit(self) -> None:
        if self.outliers == 0:
            return
        if self.velocity == "windows":
            raise wrong("a wrong position spoils all windows that hold it, take differentiated", "outliers")
        if self.on_inconsistent == "reset":
            raise wrong("a change of goal would count as an outlier, take on_inconsistent: hold", "outliers")
        if self.is_unknown or self.unknown_numbers:
            what = "gain or distance of a barrier" if self.is_unknown else self.unknown_numbers[0].name
            raise wrong(f"expected 0 with an unknown {what}", "outliers")
        if self.noise.control == "auto":
            raise wrong("auto takes an outlier for noise, give a number", "noise")

    def _require_poses(self) -> None:
        """Check, in a validator, that a body fits the rest, and that there is one if a bound on headings is given."""
        if self.body is None:
            if getattr(self.noise, "heading", 0.0):
                raise wrong(
                    "robots have headings only with a body, e.g. {kind: unicycle, map: si_to_uni}", "noise.heading"
                )
            return
        if self.is_second_order:
            raise wrong("unicycles are driven by velocities, expected dynamics: single_integrator", "body")
        if self.dimension == 3:
            raise wrong("unicycles are in the plane, and the prior says that robots are in space", "body")
        if self.velocity != "differentiated":
            raise wrong(
                f"commands of unicycles come from poses: expected 'differentiated', got {self.velocity!r}", "velocity"
            )

    @property
    def is_second_order(self) -> bool:
        """Are the robots driven by accelerations?"""
        return self.dynamics == "double_integrator"

    @property
    def dimensions(self) -> tuple[int, ...]:
        """Where the robots may be: in the plane (2), in space (3), or either, if an own task does not say it."""
        return dimensions_of(self.task, self.prior)

    @property
    def dimension(self) -> int:
        """Are the robots in the plane (2) or in space (3)? The plane, if neither is said."""
        return self.dimensions[0]

    def with_bound(self, bound: float) -> ObserveConfig:
        """The same configuration with another bound on the error of controls [`noise.unit`]."""
        return self.model_copy(update={"noise": self.noise.with_control(bound)})

    @property
    def unknown_numbers(self) -> list[UnknownNumber]:
        """The numbers given as [low, high] that are narrowed from a log before it is observed."""
        return unknown_numbers(self.task, self.barriers)

    @property
    def is_unknown(self) -> bool:
        """Has a barrier unknown safety parameters?"""
        return any(barrier.is_unknown for barrier in self.barriers)

    def build_barriers(self, bodies: Sequence[str], radius: Sequence[float] | None) -> list[Barrier | UnknownAvoidance]:
        """The barriers among these bodies, with these radii [m].

        Raises:
            ConfigError: a barrier needs radii that are not there, or names a body that is not there.
        """
        for barrier in self.barriers:
            barrier.require_radii(radius)
        return [
            barrier.build_unknown(radius)
            if isinstance(barrier, AvoidanceConfig) and barrier.is_unknown
            else barrier.build(bodies)
            for barrier in self.barriers
        ]

    @property
    def neighbour_velocities(self) -> frozenset[str]:
        """Which velocities of other bodies the barriers use: `current`, `previous`, both or none."""
        return frozenset(barrier.neighbour_velocity for barrier in self.barriers) - {"none"}

    @property
    def required(self) -> tuple[str, ...]:
        """The bodies without which a measurement says nothing about theta, such as the leader of a formation."""
        return self.task.required

    def robots(self, bodies: Sequence[str]) -> list[str]:
        """The bodies to infer: all but the obstacles and the leader of a formation, who has no offset to itself.

        Raises:
            ConfigError: the file names a body that is not there, or no robot is left.
        """
        for i, name in enumerate(self.obstacles):
            require_body(f"obstacles[{i}]", name, bodies)
        robots = [body for body in bodies if body not in self.obstacles and body not in self.required]
        if not robots:
            raise ConfigError("obstacles: no robot is left to infer")
        return robots

    def build_observer(
        self, task: Task, barriers: Sequence[Barrier | UnknownAvoidance], robots: int
    ) -> SetMembershipObserver | SafetyObserver | HybridObserver:
        """The observer of this number of robots: sets, with the filter beside them unless `ukf` is False.

        Raises:
            ConfigError: the bound on controls is `auto`, and has not been determined yet.
        """
        from torchfsid.observers.hybrid import HybridObserver
        from torchfsid.observers.safety import SafetyObserver
        from torchfsid.observers.set_membership import SetMembershipObserver

        prior, noise, tolerance = self.prior.build(robots), self.noise.build(), self.active_tolerance
        sets: SetMembershipObserver | SafetyObserver
        if self.is_unknown:
            sets = SafetyObserver(task, barriers, prior, noise, tolerance, self.on_inconsistent)
            known = sets.present_barriers
        else:
            known = [barrier for barrier in barriers if callable(barrier)]
            sets = SetMembershipObserver(
                task,
                known,
                prior,
                self.set,
                noise,
                tolerance,
                self.on_inconsistent,
                windows=self.windows or (),
                outliers=self.outliers,
            )
        if self.ukf is False or (self.body is not None and self.body.map == "si_to_uni"):
            return sets
        ukf = self.ukf.build(task, known, self.prior, robots, self.active_tolerance)
        return HybridObserver(sets, ukf, feedback=self.ukf.feedback)


def require_one_order(
    dynamics: Dynamics,
    task: TaskConfig | GivenTask,
    barriers: Sequence[BarrierConfig | GivenBarrier],
    noise: AnyNoiseConfig,
) -> None:
    """Check, in a validator, that task, barriers and noise are those of robots with these dynamics."""
    second, declared = dynamics == "double_integrator", f"dynamics: {dynamics}"
    if second and task.kind not in ("goal", GIVEN):
        raise wrong(f"expected 'goal' with {declared}, got {task.kind!r}", "task.kind")
    if second and getattr(task, "law", "proportional") != "proportional":
        raise wrong(f"expected 'proportional' with {declared}", "task.law")
    if not second and task.needs_velocity is not None:
        raise wrong("needs dynamics: double_integrator", f"task.{task.needs_velocity}")
    for i, barrier in enumerate(barriers):
        if barrier.kind == GIVEN:  # what its controls are is its own affair
            continue
        if barrier.kind == "avoidance" and barrier.is_second_order != second:
            raise wrong(f"expected {1 + second} with {declared}, got {2 - second}", f"barriers[{i}].order")
        if barrier.is_second_order != second:
            limits = "rows over accelerations, such as acceleration_box," if second else "rows over velocities"
            raise wrong(f"expected {limits} with {declared}, got {barrier.kind!r}", f"barriers[{i}].kind")
    needed = "acceleration" if second else "velocity"
    if noise.quantity != needed:
        raise wrong(f"expected a bound on {needed} with {declared}", f"noise.{needed}")
