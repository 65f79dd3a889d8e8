r"""The paper's instantaneous feasible set Omega: every theta whose QP has the observed active set (G., Eq. (13)).

    inactive rows:  A_in (G theta + f) <= b_in                   (the paper's strict < is closed, here and only here)
    multipliers:    C theta + d - (G theta + f)  in  cone{a_j : j active}

One formula covers cases A-E (G., Eqs. (19), (29), (44), (47), (54)). The "floating" eta of cases C and E, quantified by
"if there exists eta", is exactly membership in this cone. The set depends on the active rows only, not on the measured
control. It equals the critical region of multiparametric quadratic programming.

In the plane it is computed by compiled code, with its first derivatives (`kernels.regions`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import forward_ad

from torchfsid.device import on_host
from torchfsid.halfspaces import Halfspaces, array, dot
from torchfsid.identification.kkt import KktSolution, require_fit, solve_unit
from torchfsid.identification.normals import outward_normals
from torchfsid.kernels import regions
from torchfsid.tolerances import CRITICAL_NORMALS, RANK_TOLERANCE


def critical_region(
    safe_controls: Halfspaces,
    active: Bool[Tensor, "*batch m"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
) -> Halfspaces:
    """Omega as half-spaces of theta: rows 0..m-1 keep row j inactive, the others keep the multipliers non-negative.

    Rows that do not restrict theta are padding. `source` is j where row j must stay inactive, and m + j where its
    multiplier must not be negative. Controls are in the plane or in space, p is any.

    Raises:
        InputError: shapes do not fit, or controls are neither in the plane nor in space.
    """
    C, d, m = C.to(torch.float64), d.to(torch.float64), safe_controls.rows
    require_fit(safe_controls, active, C, d)
    tensors = safe_controls.A, safe_controls.b, active, C, d
    if m == 0 or safe_controls.dim != 2 or not on_host(*tensors) or _transformed():
        return _in_torch(*tensors)
    inner = 2, 1, 1, 2, 1
    batch = np.broadcast_shapes(*(t.shape[:-n] for t, n in zip(tensors, inner, strict=True)))
    flat = (t.expand(*batch, *t.shape[-n:]).reshape(-1, *t.shape[-n:]) for t, n in zip(tensors, inner, strict=True))
    A, b, source = (part.reshape(*batch, *part.shape[1:]) for part in _Region.apply(*flat))  # type: ignore[union-attr]
    return Halfspaces(A, b, source)


def _transformed() -> bool:
    """Is there a transform of torch (vmap, jvp) or a forward derivative?"""
    return torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0


def _in_torch(A: Tensor, b: Tensor, active: Tensor, C: Tensor, d: Tensor) -> Halfspaces:
    unit, active = Halfspaces(A, b).normalised(), active & (A != 0).any(-1)  # zero rows are never active
    return region_of(unit, solve_unit(unit, active, C, d), C, d)


class _Region(torch.autograd.Function):
    """(A, b, active, C, d) -> A, b and source of the region. First derivatives are compiled, others are torch's."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        found = tuple(map(torch.from_numpy, regions.critical_regions(*map(array, tensors))))
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(found[2])
        return found

    @staticmethod
    def backward(ctx: Any, grad_A: Tensor, grad_b: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        tensors, again = ctx.saved_tensors, torch.is_grad_enabled()
        many = map(torch._C._functorch.is_legacy_batchedtensor, (grad_A, grad_b))  # type: ignore[attr-defined]
        if not (again or any(many)):
            found = regions.critical_regions_vjp(*map(array, (*tensors, grad_A, grad_b)))
            of_A, of_b, of_C, of_d = map(torch.from_numpy, found)
            return of_A, of_b, None, of_C, of_d
        # Second derivatives are wanted, or the products with many vectors at once (`is_grads_batched`).
        leaves = [tensor for tensor in tensors if tensor.requires_grad]
        with torch.enable_grad():
            region = _in_torch(*tensors)
        found = torch.autograd.grad(
            (region.A, region.b), leaves, (grad_A, grad_b), create_graph=again, materialize_grads=True
        )
        grads = iter(found)
        return tuple(next(grads) if tensor.requires_grad else None for tensor in tensors)


def region_of(
    unit: Halfspaces, kkt: KktSolution, C: Float[Tensor, "*batch n p"], d: Float[Tensor, "*batch n"]
) -> Halfspaces:
    """`critical_region` for unit rows whose KKT conditions are solved already."""
    # A row in the span of the active rows does not restrict theta: u* does not move along it.
    across = unit.A.detach() @ kkt.free.detach()
    sees_theta = dot(across, across) > RANK_TOLERANCE**2
    # C theta + d - u* = P (C theta + d - A_a^+ b_a) lies in the span of the active rows: normals across it do not
    # matter.
    normals, generator, _ = outward_normals(unit.A, kkt.active, CRITICAL_NORMALS)
    along = normals @ kkt.projector
    j = torch.arange(unit.rows, device=generator.device).expand(kkt.active.shape)
    motion = torch.cat([kkt.G, kkt.f.unsqueeze(-1)], dim=-1)
    push = torch.cat([C, (d - kkt.offset).unsqueeze(-1)], dim=-1)
    rows = torch.cat([unit.A @ motion, along @ push], dim=-2)
    bounds = torch.nn.functional.pad(unit.b, (0, along.shape[-2]))
    return Halfspaces(rows[..., :-1], bounds - rows[..., -1], torch.cat([j, unit.rows + generator], dim=-1)).where(
        torch.cat([sees_theta & ~kkt.active, dot(along, along) > RANK_TOLERANCE**2], dim=-1)
    )
