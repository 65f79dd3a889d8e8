"""The compiled searches over sets, on tensors without gradients: on the CPU, or on a device that has kernels.

On a device, nothing waits for the results, and they stay there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid import device
from torchfsid.halfspaces import array
from torchfsid.kernels import disc, extent, foot

REAL, INDEX, MASK = torch.float64, torch.long, torch.bool


def farthest(vertices: Float[Tensor, "B V p"]) -> tuple[Int[Tensor, "B 2"], Float[Tensor, "B"]]:
    """The numbers of the two farthest vertices of each set, and their distance."""
    B = len(vertices)
    ends, distance = _searched(extent.farthest, (vertices,), [((B, 2), INDEX), ((B,), REAL)])
    return ends, distance


def contains(
    vertices: Float[Tensor, "B V p"],
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    reach: Float[Tensor, "B p"],
    points: Float[Tensor, "B K p"],
    tolerance: float,
) -> Bool[Tensor, "B K"]:
    """Whether points are in sets, see `kernels.extent.contains`."""
    given, shapes = (vertices, A, b, reach, points), [(points.shape[:2], MASK)]
    (inside,) = _searched(extent.contains, given, shapes, values=(tolerance,))
    return inside


def inscribed(
    vertices: Float[Tensor, "B V 2"], A: Float[Tensor, "B V 2"], b: Float[Tensor, "B V"], count: Int[Tensor, "B"]
) -> tuple[Float[Tensor, "B 2"], Float[Tensor, "B"], Int[Tensor, "B 3"], Bool[Tensor, "B"]]:
    """The largest discs of polygons: centre, radius, the rows that decide them, and whether they were found."""
    B, V = b.shape
    shapes = [((B, 2), REAL), ((B,), REAL), ((B, 3), INDEX), ((B,), MASK)]
    lines = [((B, V, 2), REAL), ((B, V), REAL)]
    centre, radius, rows, found = _searched(disc.inscribed, (vertices, A, b, count), shapes, lines)
    return centre, radius, rows, found


def feet(
    vertices: Float[Tensor, "B V 2"],
    A: Float[Tensor, "B V 2"],
    b: Float[Tensor, "B V"],
    count: Int[Tensor, "B"],
    point: Float[Tensor, "B 2"],
    metric: Float[Tensor, "B 2 2"],
) -> tuple[Float[Tensor, "B 2"], Int[Tensor, "B 2"]]:
    """The nearest points of polygons and their active rows, see `kernels.foot.feet`."""
    shapes = [((len(b), 2), REAL), ((len(b), 2), INDEX)]
    nearest, active = _searched(foot.feet, (vertices, A, b, count, point, metric), shapes)
    return nearest, active


def _searched(
    on_cpu: Callable[..., tuple],
    given: Sequence[Tensor],
    shapes: Sequence[tuple[Sequence[int], Any]],
    scratch: Sequence[tuple[Sequence[int], Any]] = (),
    values: tuple = (),
) -> tuple[Tensor, ...]:
    """What a kernel finds.

    Args:
        on_cpu: the kernel for the CPU. That for a device is the function of `kernels.cuda.programmes` of the same name.
        given: what it reads.
        shapes: the shapes and dtypes of its results.
        scratch: those of its scratch on the device.
        values: what it takes as numbers.
    """
    like = given[0]
    if not device.has_kernels(*given):
        return tuple(torch.from_numpy(part).to(like.device) for part in on_cpu(*map(array, given), *values))
    work, found = (tuple(device.empty(shape, like, dtype) for shape, dtype in part) for part in (scratch, shapes))
    device.launch(f"programmes.{on_cpu.__name__}", (given,), values, (work, found) if work else (found,))
    return found
