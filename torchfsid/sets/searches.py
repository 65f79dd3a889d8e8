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

Shapes = Sequence[tuple[Sequence[int], torch.dtype]]


def farthest(vertices: Float[Tensor, "B V p"]) -> tuple[Int[Tensor, "B 2"], Float[Tensor, "B"]]:
    """The numbers of the two farthest vertices of each set, and their distance."""
    given = (vertices,)
    if not device.has_kernels(*given):
        return _on_cpu(extent.farthest, given)
    B = len(vertices)
    return _on_device("farthest", given, [((B, 2), INDEX), ((B,), REAL)])


def contains(
    vertices: Float[Tensor, "B V p"],
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    reach: Float[Tensor, "B p"],
    points: Float[Tensor, "B K p"],
    tolerance: float,
) -> Bool[Tensor, "B K"]:
    """Whether points are in sets, see `kernels.extent.contains`."""
    given = vertices, A, b, reach, points
    if not device.has_kernels(*given):
        return _on_cpu(extent.contains, given, tolerance)[0]
    return _on_device("contains", given, [(points.shape[:2], MASK)], values=(tolerance,))[0]


def inscribed(
    vertices: Float[Tensor, "B V 2"], A: Float[Tensor, "B V 2"], b: Float[Tensor, "B V"], count: Int[Tensor, "B"]
) -> tuple[Float[Tensor, "B 2"], Float[Tensor, "B"], Int[Tensor, "B 3"], Bool[Tensor, "B"]]:
    """The largest discs of polygons: centre, radius, the rows that decide them, and whether they were found."""
    given = vertices, A, b, count
    if not device.has_kernels(*given):
        return _on_cpu(disc.inscribed, given)
    B, V = b.shape
    shapes, lines = [((B, 2), REAL), ((B,), REAL), ((B, 3), INDEX), ((B,), MASK)], [((B, V, 2), REAL), ((B, V), REAL)]
    return _on_device("inscribed", given, shapes, lines)


def feet(
    vertices: Float[Tensor, "B V 2"],
    A: Float[Tensor, "B V 2"],
    b: Float[Tensor, "B V"],
    count: Int[Tensor, "B"],
    point: Float[Tensor, "B 2"],
    metric: Float[Tensor, "B 2 2"],
) -> tuple[Float[Tensor, "B 2"], Int[Tensor, "B 2"]]:
    """The nearest points of polygons and their active rows, see `kernels.foot.feet`."""
    given = vertices, A, b, count, point, metric
    if not device.has_kernels(*given):
        return _on_cpu(foot.feet, given)
    return _on_device("feet", given, [((len(b), 2), REAL), ((len(b), 2), INDEX)])


def _on_cpu(kernel: Callable[..., tuple], given: Sequence[Tensor], *values: Any) -> Any:
    """What a kernel finds on the CPU, as tensors where the given ones are."""
    found, like = tuple(map(torch.from_numpy, kernel(*map(array, given), *values))), given[0]
    return found if like.is_cpu else tuple(part.to(like.device) for part in found)


def _on_device(kernel: str, given: Sequence[Tensor], shapes: Shapes, scratch: Shapes = (), values: tuple = ()) -> Any:
    """What a kernel of `kernels.cuda.programmes` finds, given the shapes and dtypes of its results and its scratch."""
    parts = [[device.empty(shape, given[0], dtype) for shape, dtype in part] for part in (scratch, shapes) if part]
    device.launch(f"programmes.{kernel}", (given,), values, parts)
    return tuple(parts[-1])
