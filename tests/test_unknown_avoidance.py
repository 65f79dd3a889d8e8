"""Avoidance with unknown gain and distance: half-planes of psi against the barrier with known values, by sampling."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.avoidance_within import AvoidanceWithin
from torchfsid.robots.bounds import ErrorBounds, NoiseBound
from torchfsid.robots.measurement import LeftOut, Measurement
from torchfsid.robots.unknown_avoidance import UnknownAvoidance, spow
from torchfsid.sets.feasible_set import FeasibleSet

FORMS = [
    {"power": power, **form}
    for power in (0.5, 1.0, 3.0)
    for form in (
        {"safety_distance": (0.2, 0.6)},
        {"safety_distance": (0.2, 0.6), "distance": "euclidean"},
        {"margin": (-0.05, 0.2), "reference": 0.4},
        {"margin": (-0.05, 0.2), "reference": 0.4, "distance": "euclidean"},
    )
]
N = 3000


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def uniform(generator: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def slack_of(unknown: UnknownAvoidance, psi: Tensor, radii: Tensor, x: Tensor, body: Tensor, u: Tensor, other: Tensor):
    """The unit row of the barrier with the parameters psi, and its slack at u [m/s], by the textbook."""
    away = x - body
    r = away.norm(dim=-1)
    gain, Ds = psi[..., 0] ** unknown.power, unknown.length(psi[..., 1] / psi[..., 0])
    Ds = Ds if unknown.margin is None else Ds + radii
    h = r**2 - Ds**2 if unknown.distance == "squared" else r - Ds
    alpha = gain * h.sign() * h.abs() ** unknown.power
    row = -away / r.unsqueeze(-1)
    phi = alpha / (2 * r) if unknown.distance == "squared" else alpha
    relative = u - other if unknown.neighbour_velocity == "current" else u
    return row, phi - (row * relative).sum(-1)


def psi_of(unknown: UnknownAvoidance, gain: Tensor, length: Tensor) -> Tensor:
    beta = gain ** (1 / unknown.power)
    if unknown.distance == "squared":
        length = (length + (0.0 if unknown.margin is None else unknown.reference)) ** 2
    return torch.stack([beta, beta * length], dim=-1)


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_row_is_a_half_plane_of_psi(form: dict) -> None:
    unknown, generator = UnknownAvoidance((0.3, 8.0), **form), torch.Generator().manual_seed(1)
    gain, length = uniform(generator, 0.3, 8.0, N), uniform(generator, *unknown.declared, N)
    r, radii, v = (uniform(generator, *ends, N) for ends in ((0.05, 2.0), (0.2, 0.7), (-3.0, 3.0)))
    Ds = length if unknown.margin is None else radii + length
    h = r**2 - Ds**2 if unknown.distance == "squared" else r - Ds
    alpha = gain * h.sign() * h.abs() ** unknown.power
    psi = psi_of(unknown, gain, length)
    w = psi[:, 0] * unknown.q(r, radii, length) - psi[:, 1]
    assert ((alpha >= v) == (w >= spow(v, 1 / unknown.power))).all()
    torch.testing.assert_close(spow(w, unknown.power), alpha, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_the_prior_holds_its_box_and_nothing_else(form: dict) -> None:
    unknown, generator = UnknownAvoidance((0.3, 8.0), **form), torch.Generator().manual_seed(2)
    low, high = unknown.declared
    gain, length = uniform(generator, 0.1, 12.0, N), uniform(generator, low - 0.1, high + 0.1, N)
    inside = (gain >= 0.3) & (gain <= 8.0) & (length >= low) & (length <= high)
    assert (unknown.prior(N).contains(psi_of(unknown, gain, length), 0.0) == inside).all()
    corners = torch.cartesian_prod(tensor(0.3, 8.0), tensor(low, high))
    assert unknown.prior(4).contains(psi_of(unknown, *corners.unbind(-1))).all()


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_equal_ends_are_known_values(form: dict) -> None:
    name = "margin" if "margin" in form else "safety_distance"
    for gain, length in [((2.0, 2.0), form[name]), ((0.3, 8.0), (0.1, 0.1)), ((2.0, 2.0), (0.1, 0.1))]:
        unknown = UnknownAvoidance(gain, **{**form, name: length})
        psi = unknown.prior(1)
        ends = torch.cartesian_prod(tensor(*gain), tensor(*length))
        assert psi.contains(psi_of(unknown, *ends.unbind(-1)).unsqueeze(1)).all()
        found = unknown.intervals(psi)
        torch.testing.assert_close(found.gain[0], tensor(*gain), rtol=1e-9, atol=0)
        assert gain[0] < gain[1] or torch.equal(found.gain[0], tensor(*gain))  # a known gain is printed as it is
        torch.testing.assert_close(found.distance[0], tensor(*length), rtol=1e-7, atol=0)
        by_data = unknown.bounded_by_data(psi)
        assert by_data[0].all() == (gain[0] == gain[1] and length[0] == length[1])


def cut(unknown: UnknownAvoidance, seed: int, sets: int = 40) -> tuple[FeasibleSet, Halfspaces]:
    """Sets Psi, each cut by a few half-planes around some psi."""
    generator = torch.Generator().manual_seed(seed)
    low, high = unknown.declared
    gain, length = uniform(generator, 1.0, 6.0, sets), uniform(generator, 0.7 * low + 0.3 * high, high - 0.05, sets)
    psi = psi_of(unknown, gain, length)
    q = unknown.q(uniform(generator, 0.2, 1.5, sets, 4), 0.4, 0.0)
    sign = torch.where(torch.rand(sets, 4, generator=generator) < 0.5, 1.0, -1.0).double()
    A = sign.unsqueeze(-1) * torch.stack([q, -torch.ones_like(q)], dim=-1)
    b = (A @ psi.unsqueeze(-1)).squeeze(-1) + uniform(generator, 0.0, 0.1, sets, 4)
    return unknown.prior(sets).intersect(Halfspaces(A, b)), Halfspaces(A, b)


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_intervals_and_speeds_are_those_of_samples(form: dict) -> None:
    unknown = UnknownAvoidance((0.3, 8.0), **form)
    psi, _ = cut(unknown, 3)
    corners = psi.vertices()
    along = torch.linspace(0, 1, 400, dtype=torch.float64)[:, None, None, None]
    edges = (along * corners + (1 - along) * corners.roll(-1, 1)).permute(1, 0, 2, 3).flatten(1, 2)
    generator = torch.Generator().manual_seed(4)
    share = -uniform(generator, 0.0, 1.0, len(corners), 200, corners.shape[1]).log()
    points = torch.cat([edges, (share / share.sum(-1, keepdim=True)) @ corners], dim=1)
    beta, D = points[..., 0], points[..., 1] / points[..., 0]
    gain = beta**unknown.power
    length = D.sqrt() if unknown.distance == "squared" else D
    if unknown.distance == "squared" and unknown.margin is not None:
        length = length - unknown.reference
    r = tensor(0.15, 0.5, 1.7)
    known_radii = unknown.margin is not None
    Ds = length + (unknown.reference if known_radii else 0.0)
    h = r[:, None, None] ** 2 - Ds**2 if unknown.distance == "squared" else r[:, None, None] - Ds
    speed = gain * h.sign() * h.abs() ** unknown.power
    speed = speed / (2 * r[:, None, None] if unknown.distance == "squared" else 1.0)
    found = unknown.intervals(psi)
    bands = unknown.approach_speed(psi, r).unbind(1)
    for interval, values in [(found.gain, gain), (found.distance, length), *zip(bands, speed, strict=True)]:
        sampled = torch.stack([values.amin(1), values.amax(1)], dim=-1)
        torch.testing.assert_close(interval, sampled, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_an_end_is_bounded_by_data_if_a_wider_prior_leaves_it(form: dict) -> None:
    unknown = UnknownAvoidance((0.3, 8.0), **form)
    low, high = unknown.declared
    wider = replace(unknown, gain=(0.29, 8.1), **{"margin" if "margin" in form else "safety_distance": (
        low - 0.01, high + 0.01)})  # fmt: skip
    psi, rows = cut(unknown, 5)
    before, after = unknown.intervals(psi), wider.intervals(wider.prior(len(rows.b)).intersect(rows))
    counted = 0
    for by_data, tight, loose in zip(unknown.bounded_by_data(psi), before, after, strict=True):
        stays = (tight - loose).abs() <= 1e-9
        assert torch.equal(by_data, stays)
        counted += int(stays.sum())
    assert 0 < counted < 4 * len(rows.b)


def test_small_values_far_inside_a_huge_prior_are_bounded_by_data() -> None:
    """An end counts as that of the prior for its distance from it, not for its size beside the whole prior."""
    unknown = UnknownAvoidance((1e-3, 1e5), (1e-3, 1e3))
    A = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.09, -1.0], [-0.16, 1.0]], dtype=torch.float64)
    psi = unknown.prior(1).intersect(Halfspaces(A, tensor(0.06, -0.05, 0.0, 0.0)))
    assert all(bool(by_data.all()) for by_data in unknown.bounded_by_data(psi))


@pytest.mark.parametrize("neighbour", ["none", "current"])
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_rows_hold_for_all_errors_within_their_bounds(form: dict, neighbour: str) -> None:
    """Sampled truths: psi in Psi, positions, controls and the neighbours' velocities off by up to their bounds."""
    unknown = UnknownAvoidance((0.3, 8.0), neighbour_velocity=neighbour, **form)
    generator = torch.Generator().manual_seed(6)
    sets, _ = cut(unknown, 7, 60)
    corners = sets.vertices().repeat(N // 60, 1, 1)
    share = -uniform(generator, 0.0, 1.0, N, 1, corners.shape[1]).log() * 2
    psi = ((share / share.sum(-1, keepdim=True)) @ corners).squeeze(1)
    psi[::2] = corners[::2, 0]

    def speed(w: Tensor) -> Tensor:  # w is a root of it, which magnifies round-off near 0
        return w.sign() * w.abs() ** unknown.power

    def around(bound: float) -> Tensor:
        angle, size = uniform(generator, 0, 6.3, N), uniform(generator, 0, 1, N).clamp(min=0.5) * 2 - 1
        return 0.999999 * bound * size.abs().unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)

    x, angle, r = uniform(generator, -1, 1, N, 2), uniform(generator, 0, 6.3, N), uniform(generator, 0.1, 1.5, N)
    body = x + r.unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)
    u, other = uniform(generator, -1, 1, N, 2), uniform(generator, -1, 1, N, 2)
    radii = uniform(generator, 0.1, 0.3, N, 2)

    def measured(x: Tensor, body: Tensor, u: Tensor, other: Tensor) -> Measurement:
        return Measurement(
            0.0, x, u, body.unsqueeze(1), torch.ones(N, 1, dtype=torch.bool), other.unsqueeze(1),
            radius=radii[:, 0], body_radii=radii[:, 1:],
        )  # fmt: skip

    towards, slack = slack_of(unknown, psi, radii.sum(-1), x, body, u, other)
    for position, velocity in [(0.0, 0.0), (0.0, 0.01), (0.03, 0.01)]:
        bounds = NoiseBound(velocity, position=position, neighbour_velocity=velocity)
        on_row = u + slack.unsqueeze(-1) * towards
        for truly, active in ((u, False), (on_row, True)):
            control = truly + around(velocity)
            seen = measured(x + around(position), body + around(position), control, other + around(velocity))
            within = AvoidanceWithin(unknown, corners)
            errors = ErrorBounds.of(seen, bounds) or ErrorBounds.none(seen)
            rows = within.safety_rows(seen, errors, torch.full((N, 1), velocity, dtype=torch.float64))
            kept, active_w = (psi[:, :1] * q - psi[:, 1:] for q in (rows.kept_q, rows.active_q))
            round_off = 1e-12 * (1 + (psi[:, :1] * rows.kept_q.abs() + psi[:, 1:].abs()).amax())
            holds = (slack >= 0) | active
            over = (rows.low - kept).squeeze(-1)
            assert over[holds].max() <= round_off
            if active:
                over_w, over_speed = active_w - rows.high, speed(active_w) - speed(rows.high)
                assert torch.minimum(over_w, over_speed).max() <= round_off
                near = velocity + within.errors(seen, errors).slack
                assert (within(seen).normalised().slack(control) <= near + 1e-12).all()
            elif position == velocity == 0 and (unknown.margin is None or unknown.distance == "euclidean"):
                assert over[~holds].min() > -1e-9  # where q is exact, a violated row is cut off


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_bodies_without_a_slot_are_as_near_as_they_can_be(form: dict) -> None:
    """The least slack is at most that of any body beyond the distance, for all of Psi."""
    unknown = UnknownAvoidance((0.3, 8.0), neighbour_velocity="current", **form)
    generator = torch.Generator().manual_seed(8)
    psi = cut(unknown, 9, 200)[0].vertices()
    nearest, radius = uniform(generator, 0.2, 1.5, 200), uniform(generator, 0.1, 0.3, 200, 2)
    u, speed = uniform(generator, -1, 1, 200, 2), uniform(generator, 0, 1, 200)
    empty = torch.zeros(200, 0, 2, dtype=torch.float64)
    seen = Measurement(
        0.0, torch.zeros(200, 2).double(), u, empty, torch.zeros(200, 0, dtype=torch.bool), empty,
        radius=radius[:, 0], body_radii=empty[..., 0], left_out=LeftOut(nearest, speed, radius[:, 1], speed),
    )  # fmt: skip
    least = AvoidanceWithin(unknown, psi).slack_left_out(seen)
    towards = u / u.norm(dim=-1, keepdim=True)
    for corner in psi.unbind(1):
        for farther, smaller in ((1.0, 1.0), (1.3, 1.0), (1.0, 0.5)):
            body, other = farther * nearest.unsqueeze(-1) * towards, -speed.unsqueeze(-1) * towards
            radii = radius[:, 0] + smaller * radius[:, 1]
            assert (least <= slack_of(unknown, corner, radii, seen.x, body, u, other)[1] + 1e-9).all()


def test_what_is_refused() -> None:
    for wrong in [
        {"gain": (0.0, 1.0), "safety_distance": (0.1, 0.2)},
        {"gain": (2.0, 1.0), "safety_distance": (0.1, 0.2)},
        {"gain": (1.0, 2.0), "safety_distance": (0.1, float("inf"))},
        {"gain": (1.0, 2.0)},
        {"gain": (1.0, 2.0), "safety_distance": (0.1, 0.2), "margin": (0.0, 0.1)},
        {"gain": (1.0, 2.0), "margin": (0.0, 0.1)},
        {"gain": (1.0, 2.0), "safety_distance": (0.1, 0.2), "power": 0.0},
    ]:
        with pytest.raises(InputError):
            UnknownAvoidance(**wrong)
