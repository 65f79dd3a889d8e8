r"""Points that are uniformly distributed over convex sets, given by their vertices.

A set is divided into simplices. One is drawn with a probability proportional to its volume, and in it a point
sum_i w_i v_i, whose weights w are uniform on the standard simplex: independent exponential numbers over their sum.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import Delaunay
from torch import Tensor


def uniform(
    vertices: Float[Tensor, "B v p"], samples: int, generator: torch.Generator | None
) -> Float[Tensor, "samples B p"]:
    """Points of each set, without gradients. Items whose vertices are NaN give NaN."""
    corners = vertices.detach().cpu()
    points = [_of_one(of_item, samples, generator) for of_item in corners]
    return (
        torch.stack(points, dim=1).to(vertices.device) if points else vertices.new_zeros(samples, 0, corners.shape[2])
    )


def _of_one(vertices: Float[Tensor, "v p"], samples: int, generator: torch.Generator | None) -> Tensor:
    if bool(vertices.isnan().any()):
        return vertices.new_full((samples, vertices.shape[1]), torch.nan)
    simplices = _simplices(vertices)
    edges = simplices[:, 1:] - simplices[:, :1]
    volumes = torch.linalg.det(edges).abs() / math.factorial(edges.shape[-1])
    volumes = volumes if bool(volumes.sum() > 0) else torch.ones_like(volumes)
    device = torch.device("cpu") if generator is None else generator.device
    chosen = torch.multinomial(volumes.to(device), samples, replacement=True, generator=generator).cpu()
    shape = samples, edges.shape[-1] + 1
    shares = torch.empty(shape, dtype=torch.float64, device=device).exponential_(generator=generator).cpu()
    return ((shares / shares.sum(-1, keepdim=True)).unsqueeze(-1) * simplices[chosen]).sum(-2)


def _simplices(vertices: Float[Tensor, "v p"]) -> Float[Tensor, "s p+1 p"]:
    """Simplices that fill the hull of the vertices. In the plane these are in order, and form a fan."""
    v, p = vertices.shape
    if p == 1:
        return torch.stack([vertices.amin(0), vertices.amax(0)]).unsqueeze(0)
    if p == 2:
        fan = torch.stack([torch.zeros(v - 2, dtype=torch.long), torch.arange(1, v - 1), torch.arange(2, v)], dim=-1)
        return vertices[fan]
    distinct = torch.unique(vertices, dim=0)
    offsets = distinct - distinct.mean(0)
    _, sizes, axes = torch.linalg.svd(offsets, full_matrices=False)
    round_set = offsets @ axes.mT / sizes.clamp(min=1e-12 * float(sizes[0]))  # a long set has flat simplices
    return distinct[torch.from_numpy(Delaunay(np.asarray(round_set), qhull_options="QJ").simplices).long()]
