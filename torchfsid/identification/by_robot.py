"""Half-spaces of several samples, read as one batch, gathered for each robot."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfsid.halfspaces import Halfspaces


def by_robot(omega: Halfspaces, t: float | Tensor, robots: int) -> tuple[Halfspaces, float | Tensor]:
    """The half-spaces of each robot's samples as one set of rows, and their times, for several samples concatenated.

    Args:
        omega: the half-spaces (samples * robots, R), sample by sample.
        t: the times of the items [s].
        robots: the number of robots.
    """
    if len(omega.b) == robots:
        return omega, t.unsqueeze(-1) if isinstance(t, Tensor) and t.ndim > 0 else t

    def gathered(items: Tensor) -> Tensor:
        return items.unflatten(0, (-1, robots)).transpose(0, 1).flatten(1, 2)

    source = None if omega.source is None else gathered(omega.source)
    times = torch.as_tensor(t, dtype=torch.float64).expand(len(omega.b)).unsqueeze(-1).expand(-1, omega.rows)
    return Halfspaces(gathered(omega.A), gathered(omega.b), source), gathered(times)
