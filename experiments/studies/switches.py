"""What automatic differentiation does not see: the area for one goal jumps where its active sets switch.

A still probe is moved along y, across the corridor. Between two switches of the history of active sets, A is smooth and
automatic differentiation gives d log A/dy. At a switch A jumps, and automatic differentiation gives a one-sided
derivative. So the integral of these derivatives differs from the change of log A.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.design.probe import Probing, slope
from experiments.results import rows_of
from torchfsid.identification.evidence import evidence

REACH = 0.1
"""The probe is moved so far, to either side [m]."""

PLACES = 801
"""On this way."""


def across(probing: Probing, place: Float[Tensor, "2"], goal: Float[Tensor, "2"]) -> list[dict[str, Any]]:
    """Move a still probe across the corridor. One table row per allowed place.

    A table row has the log of the area [m^2], the integral of the derivatives from the first place, and the number of
    switches so far.
    """
    places = place.repeat(PLACES, 1, 1)
    places[:, 0, 1] += torch.linspace(-REACH, REACH, PLACES, dtype=torch.float64)
    places = places[(probing.allowed(places) == places).flatten(1).all(-1)].requires_grad_()
    goals = goal.unsqueeze(0)
    log_area = probing.left(places, goals).area[:, 0].log()
    slopes, y = slope(log_area.sum(), places)[:, 0, 1], places.detach()[:, 0, 1]
    log_area = log_area.detach()
    with torch.no_grad():
        seen = probing.run(places, goals).measurement()
        history = evidence(probing.model, probing.prior_of(1), seen).kkt.active.unflatten(0, (len(places), -1))
    switched = (history[1:] != history[:-1]).flatten(1).any(-1).long()
    columns = {
        "y": y,
        "log_area": log_area,
        "by_derivatives": torch.cat([log_area[:1], log_area[0] + torch.cumulative_trapezoid(slopes, y)]),
        "switches": torch.cat([switched.new_zeros(1), switched.cumsum(0)]),
    }
    return rows_of({name: column.tolist() for name, column in columns.items()})


def summarise_switches(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The number of switches, the change of log A along the way, and the integral of the derivatives."""
    first, last = rows[0], rows[-1]
    return {
        "way [m]": last["y"] - first["y"],
        "switches": last["switches"],
        "change of log A": last["log_area"] - first["log_area"],
        "its derivatives add up to": last["by_derivatives"] - first["log_area"],
    }
