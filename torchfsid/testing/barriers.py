r"""The checks of the test kit. docs/your_own_controller.md says what follows for an observer from each member.

The checks are experiments: they draw true situations, measure them with errors up to and at the bounds, and compare. A
check that fails gives numbers, a check that passes proves nothing. Optional members are checked only if they are there:
without them the observer assumes the worst.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import BarrierError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.identification.evidence import Evidence, ObservationModel, evidence
from torchfsid.robots.barriers import Barrier, possible_rows, row_errors
from torchfsid.robots.bounds import ErrorBounds, NoiseBound, RowErrors
from torchfsid.robots.measurement import LeftOut, Measurement
from torchfsid.robots.tasks import VelocityTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.testing.situations import (
    direction,
    first_order,
    generator,
    measured,
    motions,
    normal,
    of_tensors,
    on_boundary,
    random_situations,
    repeated,
    spoilt,
    uniform,
)

SIZES = (1e-3, 0.03, 0.3)
"""Bounds on the errors that are tried, in the units of positions, velocities and controls."""

CLOSE = 1e-8
"""Difference that counts as round-off, relative to numbers of the order of one."""

OfRows = Callable[[Measurement], Float[Tensor, "*batch m"]]


def check_barrier(
    barrier: Barrier,
    situations: Measurement | None = None,
    *,
    h: OfRows | None = None,
    alpha: Callable[[Tensor], Tensor] | None = None,
    motion: Callable[[Measurement, float], Measurement] = first_order,
    seed: int = 0,
) -> None:
    """Run all checks of this module, in the plane or in space.

    Args:
        barrier: any object with the members of `Barrier`.
        situations: true states (B, ...) of robots among bodies, in some of which the barrier has active rows. The
            controls in it are ignored. Default: `random_situations(seed)`.
        h: the barrier function of every row, for `check_derivative`. Without it and `alpha` that check is left out.
        alpha: the class-K function of the rows.
        motion: where everything is after so many seconds, `first_order` or `second_order`.
        seed: of all that is drawn.

    Raises:
        BarrierError: some checks failed. The message has a line for each.
    """
    situations = random_situations(seed) if situations is None else situations
    checks: list[Callable[[Barrier, Measurement, int], None]]
    checks = [check_labels, check_padding, check_batch, check_errors, check_left_out]
    if situations.x.shape[-1] in (2, 3):
        checks += [check_soundness, check_compiled]
    if h is not None and alpha is not None:
        checks.append(lambda *args: check_derivative(*args, h=h, alpha=alpha, motion=motion))
    failures = []
    for check in checks:
        try:
            check(barrier, situations, seed)
        except BarrierError as error:
            failures.append(str(error))
    if failures:
        raise BarrierError("\n".join(failures))


def check_labels(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """Every row has a name of its own: an alarm names the row that was violated."""
    rows, names = barrier(situations).rows, _names(barrier, situations)
    if not rows == len(names) == len(set(names)):
        raise BarrierError(f"check_labels: {rows} rows, but these names: {', '.join(names)}")


def check_padding(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """An absent body has no influence, whatever its slot holds, and its row is 0.u <= 1, without errors.

    A zero row with an error counts as a row of unknown direction.
    """
    draw = generator(seed)
    some = replace(situations, present=situations.present & (uniform(situations.bodies[..., 0], draw) < 0.5))
    seen, noise = measured(some, SIZES[1], draw)
    for garbage in (math.nan, 1e6):
        filled = of_tensors(seen, partial(spoilt, seen.present, garbage))
        _same("check_padding", barrier, filled, seen, noise, f"slots of absent bodies hold {garbage}")
    nobody = replace(seen, present=torch.zeros_like(seen.present))
    rows, errors = barrier(nobody), _errors(barrier, nobody, noise)
    padding, names = (rows.A == 0).all(-1), _names(barrier, seen)
    _at_most((rows.b - 1).abs().where(padding, 0.0), 0.0, "check_padding: a zero row is not 0.u <= 1: |b - 1|", names)
    if hasattr(barrier, "errors"):
        total = (errors.angle + errors.slack).where(padding, 0.0)
        _at_most(total, 0.0, "check_padding: the row of an absent body has errors: angle + slack", names)


def check_batch(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """A robot's rows are the same alone, in any order, and in a batch of batches.

    A log is one batch of all its samples. A simulation may run a batch of teams.
    """
    draw = generator(seed)
    seen, noise = measured(situations, SIZES[1], draw)
    far = 5 * uniform(seen.x[..., 0], draw)
    seen = replace(seen, left_out=LeftOut(far, far / 5, far / 50, far / 5))
    order = torch.randperm(len(far), generator=draw).to(far.device)
    for k in range(min(8, len(far))):
        _same("check_batch", barrier, seen.select(order[k : k + 1]), seen, noise, "a robot is alone", order[k : k + 1])
    _same("check_batch", barrier, seen.select(order), seen, noise, "robots are in another order", order)
    pairs = order[: len(order) // 2 * 2]
    grouped = of_tensors(seen.select(pairs), lambda name, value: value.unflatten(0, (2, -1)))
    _same("check_batch", barrier, grouped, seen, noise, "robots are in two batches", pairs)


def check_errors(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """A truly active row is measured within `errors`: its direction within `angle`, its slack within `slack`.

    The true control lies on the boundary of the true row. Its own error may add to the slack. With `rows_within`, it is
    enough that some row covers the true one: has it within its angle, and no more slack.
    """
    if not hasattr(barrier, "errors"):
        return
    draw, tried, true, within = generator(seed), 0, repeated(situations), hasattr(barrier, "rows_within")
    for size in SIZES:
        for j, name in zip(range(barrier(true).rows), _names(barrier, situations), strict=False):
            active, row, exists = on_boundary(barrier, true, j, draw)
            seen, noise = measured(active, size, draw)
            bounds, told, u = ErrorBounds.of(seen, noise), _errors(barrier, seen, noise), _control(seen)
            assert bounds is not None
            unit, error = possible_rows(barrier, seen, bounds).normalised(), bounds.control.unsqueeze(-1)
            anywhere = (told.angle >= math.pi) | ((told.angle > 0) & (unit.A == 0).all(-1))
            turned = (2 * ((unit.A - row).norm(dim=-1) / 2).clamp(max=1.0).arcsin()).masked_fill(anywhere, 0.0)
            slack = unit.slack(u)
            found = {"rad off": (turned, told.angle), "m/s from its boundary": (slack - error, told.slack)}
            place = torch.full_like(turned[:, :1], j, dtype=torch.int64)
            if within:
                place = torch.maximum(turned - told.angle, slack - error - told.slack).argmin(-1, keepdim=True)
            elif not barrier.soft:
                found["m/s violated"] = (-slack - error, told.slack)
            for what, (measure, bound) in found.items():
                text = f"check_errors: errors up to {size}, row '{name}' is active, and measured {what}:"
                limit = bound.gather(-1, place) + CLOSE * (1 + u.norm(dim=-1, keepdim=True))
                _at_most(measure.gather(-1, place).where(exists.unsqueeze(-1), -math.inf), limit, text)
            tried += int(exists.sum())
    if tried == 0:
        raise BarrierError("check_errors: no row exists in these situations; give others")


def check_left_out(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """The row of a body without a slot has at least the slack `slack_left_out`, if the body is as `left_out` says.

    Robots of a fleet have slots for their nearest bodies only. With too large a slack, active rows are overlooked.
    """
    if not hasattr(barrier, "slack_left_out") or situations.present.shape[-1] == 0:
        return
    draw = generator(seed)
    true = repeated(situations)
    distance, speed, radius, own_speed, worst = (uniform(true.x[:, 0], draw) for _ in range(5))
    distance, at_bound = 0.1 * (4.6 * distance).exp(), (worst < 0.5).unsqueeze(-1)
    away = direction(true.x, draw)
    u, toward = (torch.where(at_bound, v, direction(true.x, draw)) for v in (away, -away))
    further, slower = (torch.where(at_bound, 0.0, uniform(true.x[:, :1], draw)) for _ in range(2))

    def first(of_bodies: Tensor, value: Tensor) -> Tensor:
        return torch.cat([value.unsqueeze(1), of_bodies[:, 1:]], dim=1)

    body = {
        "bodies": true.x + away * distance.unsqueeze(-1) * (1 + further),
        "present": torch.ones_like(true.present[:, 0]),
        "body_velocities": toward * speed.unsqueeze(-1) * (1 - slower),
        "previous_body_velocities": toward * speed.unsqueeze(-1) * (1 - slower),
        "body_accelerations": toward * speed.unsqueeze(-1) * (1 - slower),
        "body_radii": radius,
    }
    whole = of_tensors(true, lambda name, value: first(value, body[name]) if name in body else value)
    whole = replace(whole, u=u * 2 * own_speed.unsqueeze(-1))
    without = replace(whole, present=first(whole.present, ~whole.present[:, 0]))
    rows, others = barrier(whole), barrier(without)
    told = barrier.slack_left_out(replace(without, left_out=LeftOut(distance, speed, radius, speed)))  # type: ignore[attr-defined]
    added = (rows.A != 0).any(-1) & ((rows.A != others.A).any(-1) | (rows.b != others.b))
    least = rows.slack(_control(whole)).masked_fill(~added, math.inf).amin(-1, keepdim=True)
    _at_most(told.unsqueeze(-1), least + CLOSE, "check_left_out: `slack_left_out` is more than the row's slack [m/s]")


def check_soundness(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """The true parameter is in the set that a measurement gives, and no alarm is false.

    The robots want random velocities and solve their QP at the truth.
    """
    held = 0
    for text, true, theta, read in _readings("check_soundness", barrier, situations, seed):
        held += int((barrier(true).slack(_control(true)) < CLOSE).any(-1).sum())
        found = read(False)
        scale = CLOSE * (1 + theta.norm(dim=-1, keepdim=True))
        _at_most(-found.omega.slack(theta).amin(-1, keepdim=True), scale, f"{text} the truth is outside its set by")
        beyond = found.excess.masked_fill(~found.alarmed.unsqueeze(-1), -math.inf)
        _at_most(beyond, 0.0, f"{text} a false alarm: violation beyond the bound")
    if held == 0:
        raise BarrierError("check_soundness: no row is active in these situations; give others")


@torch.no_grad()
def check_compiled(barrier: Barrier, situations: Measurement, seed: int = 0) -> None:
    """Compiled code says of a measurement what torch says: the same slacks, verdicts and sets."""
    for text, _, theta, read in _readings("check_compiled", barrier, situations, seed):
        points, pair = theta + normal(theta, generator(seed)), (read(True), read(False))
        for what in ("informative", "alarmed", "infeasible"):
            compiled, in_torch = (getattr(found, what).double().unsqueeze(-1) for found in pair)
            _at_most((compiled - in_torch).abs(), 0.0, f"{text} `{what}` differs in compiled code")
        for where in (theta, points):
            compiled, in_torch = (_nearest_row(found.omega, where) for found in pair)
            _at_most(_difference(compiled, in_torch), CLOSE, f"{text} distances to the set differ in compiled code")


def check_derivative(
    barrier: Barrier,
    situations: Measurement,
    seed: int = 0,
    *,
    h: OfRows,
    alpha: Callable[[Tensor], Tensor],
    motion: Callable[[Measurement, float], Measurement] = first_order,
) -> None:
    """Every row says dh/dt >= -alpha(h): dh/dt + alpha(h) = c (b - A u) for every u, with a c > 0 of its own.

    dh/dt is a finite difference along `motion`. Bodies move with the velocities that the rows use
    (`neighbour_velocity`), so they stand still if these are `none`.
    """
    draw, step, names = generator(seed), 1e-5, _names(barrier, situations)
    velocities = {"none": torch.zeros_like(situations.bodies), "previous": situations.previous_body_velocities}
    used = velocities.get(getattr(barrier, "neighbour_velocity", "current"), situations.body_velocities)
    rooms, rates = [], []
    for _ in range(situations.x.shape[-1] + 2):
        now = replace(situations, u=normal(situations.x, draw), body_velocities=used)
        rows, ahead, behind = barrier(now), h(motion(now, step)), h(motion(now, -step))
        rooms.append(rows.b - dot(rows.A, _control(now).unsqueeze(-2)))
        rates.append((ahead - behind) / (2 * step) + alpha(h(now)))
    room, rate, exists = torch.stack(rooms), torch.stack(rates), (rows.A != 0).any(-1)
    c = (room * rate).sum(0) / room.square().sum(0)
    off = (rate - c * room).abs().amax(0) / (1 + rate.abs().amax(0))
    _at_most(off.where(exists, 0.0), 1e-5, "check_derivative: the row is not dh/dt + alpha(h) >= 0: relative", names)
    _at_most(-c.where(exists, 1.0), 0.0, "check_derivative: the row has the wrong sign: scale", names)


def _readings(
    check: str, barrier: Barrier, situations: Measurement, seed: int
) -> Iterator[tuple[str, Measurement, Tensor, Callable[[bool], Evidence]]]:
    """For errors of every size: a text, true motions, their true parameters, and the evidence, compiled or not."""
    draw = generator(seed)
    for size in (0.0, *SIZES):
        true, theta = motions(barrier, repeated(situations), draw)
        seen, noise = measured(true, size, draw)
        model, corner = ObservationModel(VelocityTask(theta.shape[-1]), [barrier], noise=noise), theta.abs() + 1
        read = partial(evidence, model, FeasibleSet.from_box(-corner, corner), seen)
        yield f"{check}: errors up to {size},", true, theta, read


def _control(measurement: Measurement) -> Tensor:
    assert measurement.u is not None
    return measurement.u


def _names(barrier: Barrier, measurement: Measurement) -> list[str]:
    return barrier.labels([f"body {j}" for j in range(measurement.present.shape[-1])])


def _errors(barrier: Barrier, seen: Measurement, noise: NoiseBound) -> RowErrors:
    bounds = ErrorBounds.of(seen, noise) or ErrorBounds.none(seen)
    return row_errors([barrier], [possible_rows(barrier, seen, bounds)], seen, bounds)


def _same(
    check: str, barrier: Barrier, seen: Measurement, of_all: Measurement, noise: NoiseBound, where: str,
    items: Tensor | None = None,
) -> None:  # fmt: skip
    """Does the barrier say of `seen` what it says of the same robots, the `items` of `of_all`?"""
    for (what, found), (_, expected) in zip(
        _answers(barrier, seen, noise), _answers(barrier, of_all, noise), strict=True
    ):
        found = found.flatten(0, found.ndim - 3) if found.ndim > 3 else found
        _at_most(
            _difference(found, expected if items is None else expected[items]).flatten(1), CLOSE,
            f"{check}: {what} differ where {where}: by",
        )  # fmt: skip


def _answers(barrier: Barrier, seen: Measurement, noise: NoiseBound) -> Iterator[tuple[str, Tensor]]:
    """All that a barrier says of a measurement, each as a tensor (*batch, rows, k)."""
    bounds = ErrorBounds.of(seen, noise)
    for what, rows in [("rows", barrier(seen)), ("rows within the bounds", possible_rows(barrier, seen, bounds))]:
        yield what, torch.cat([rows.A, rows.b.unsqueeze(-1)], dim=-1)
    yield "errors", torch.stack(_errors(barrier, seen, noise), dim=-1)
    if seen.left_out is not None and hasattr(barrier, "slack_left_out"):
        yield "slacks left out", barrier.slack_left_out(seen)[..., None, None]  # type: ignore[attr-defined]


def _difference(found: Tensor, expected: Tensor) -> Tensor:
    """Relative to numbers of the order of one; infinite where only one of the two is finite."""
    same = (found == expected) | (found.isnan() & expected.isnan())
    off = (found - expected).abs() / (1 + expected.abs())
    return torch.where(same, 0.0, off.nan_to_num(math.inf))


def _nearest_row(omega: Halfspaces, point: Tensor) -> Tensor:
    """The slack of the row of which `point` has the least; infinite if there are no rows."""
    return omega.slack(point).where((omega.A != 0).any(-1), math.inf).amin(-1, keepdim=True)


def _at_most(found: Tensor, allowed: Tensor | float, text: str, names: Sequence[str] = ()) -> None:
    """Raises `BarrierError` with the worst number if some of `found` (B, k) exceed what is allowed."""
    beyond = found - allowed
    wrong = beyond > 0
    if bool(wrong.any()):
        robot, column = divmod(int(beyond.masked_fill(~wrong, -math.inf).argmax()), found.shape[1])
        limit = float(torch.as_tensor(allowed, dtype=found.dtype).expand_as(found)[robot, column])
        row = f", row '{names[column]}'" if len(names) == found.shape[1] else ""
        raise BarrierError(
            f"{text} {float(found[robot, column]):.4g}, at most {limit:.4g} (robot {robot}{row}; "
            f"{int(wrong.any(-1).sum())} of {len(found)} measurements)"
        )
