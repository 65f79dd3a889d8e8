"""Evidence by compiled code: when it can be used, and the way of a sample's numbers to the kernels and back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfsid import device
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, array
from torchfsid.identification import compiled_in_space
from torchfsid.identification.kkt import KktSolution
from torchfsid.kernels import evidence as kernel

if TYPE_CHECKING:
    from torchfsid.identification.evidence import ObservationModel, Sample

NO_CLIP = (np.empty(0), False, 0.0, np.empty((0, 0, 2)))
"""`clip` of `kernels.evidence` for nominal controls that are not clipped."""


Details = Callable[[], tuple[Tensor, Tensor, KktSolution]]
"""Computes slack and excess, as in `Evidence`, and the KKT conditions."""

Read = tuple[Halfspaces, tuple[Tensor, Tensor, Tensor], Details]
"""The half-spaces, the fields `informative`, `alarmed` and `infeasible` of `Evidence`, and the other ones."""


def can_be_compiled(model: ObservationModel, sample: Sample, wanted: bool | None) -> bool:
    """Does compiled code read this sample? See `compiled` of `evidence`.

    Raises:
        InputError: it is `wanted`, but not possible.
    """
    if wanted is False:
        return False
    tensors = [sample.rows.A, sample.rows.b, sample.C, sample.d, sample.u, sample.bound, sample.ball, sample.drift]
    if model.task.saturation is not None and sample.corners is not None:
        tensors.append(sample.corners)
    obstacle, in_space, clipped = None, sample.rows.dim == 3, model.task.saturation is not None
    if sample.rows.dim not in (2, 3):
        obstacle = "controls are neither in the plane nor in space"
    elif clipped and not in_space and sample.C.shape[-1] != 2:
        obstacle = "the nominal control is clipped, and theta is not planar"
    elif in_space and model.relaxes:
        obstacle = "rows are relaxed, in space"
    elif torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        obstacle = "gradients are required"
    elif not all(tensor.is_cpu for tensor in tensors):
        obstacle = _obstacle_on_device(tensors, sample.rows)
    if wanted and obstacle is not None:
        raise InputError("compiled", "False or None", f"True, but {obstacle}")
    return obstacle is None


def _obstacle_on_device(tensors: Sequence[Tensor], rows: Halfspaces) -> str | None:
    if not all(tensor.is_cuda for tensor in tensors):
        return "tensors are neither all on the CPU nor all on CUDA"
    if rows.rows == 0:
        return "tensors are on CUDA, and there are no rows"
    return device.missing() or None


def read(model: ObservationModel, sample: Sample) -> Read:
    """What the kernels say of a sample. In the plane slacks and KKT conditions are computed when they are asked for."""
    if sample.rows.dim == 3:
        omega, (informative, alarmed, infeasible, slack, excess), kkt = compiled_in_space.read(model, sample)
        return omega, (informative, alarmed, infeasible), lambda: (slack, excess, kkt)
    if sample.rows.rows > 0 and device.has_kernels(sample.rows.A, sample.u):
        return _read_on_device(model, sample)
    angles = sample.u[:, :0] if sample.row_errors is None else sample.row_errors.angle
    rows, relaxed = (sample.rows.A, sample.rows.b, sample.hard), (sample.relaxed,)
    others = (
        sample.C, sample.d, sample.u, sample.usable,
        torch.atleast_2d(sample.bound), angles, torch.atleast_1d(sample.ball), torch.atleast_1d(sample.drift),
    )  # fmt: skip
    saturation, paper, clip = model.task.saturation, model.kind == "critical_region", NO_CLIP
    if saturation is not None:
        assert sample.corners is not None
        limits = np.array(saturation.limits, dtype=np.float64)
        clip = limits, saturation.shape == "norm", float(saturation.dead_speed), array(sample.corners)
    half_spaces, judged = kernel.evidence(*map(array, rows + relaxed + others), clip, paper, model.active_tolerance)
    informative, alarmed, infeasible = map(torch.from_numpy, judged)
    details = cache(partial(_details, model.active_tolerance, sample))
    return Halfspaces(*map(torch.from_numpy, half_spaces)), (informative, alarmed, infeasible), details


def _details(tolerance: float, sample: Sample) -> tuple[Tensor, Tensor, KktSolution]:
    tensors = sample.rows.A, sample.rows.b, sample.hard, sample.relaxed, sample.C, sample.d, sample.u
    slacks, kkt = kernel.details(*map(array, (*tensors, torch.atleast_2d(sample.bound))), tolerance)
    slack, excess = map(torch.from_numpy, slacks)
    return slack, excess, KktSolution(*map(torch.from_numpy, kkt))


def _read_on_device(model: ObservationModel, sample: Sample) -> Read:
    """What the device's kernels say."""
    paper, saturation, u = model.kind == "critical_region", model.task.saturation, sample.u
    (B, m, _), p, bound = sample.rows.A.shape, sample.C.shape[-1], torch.atleast_2d(sample.bound)
    given = (
        (sample.rows.A, sample.rows.b, sample.hard, sample.relaxed),
        (sample.C, sample.d, u, sample.usable),
        (bound, torch.atleast_1d(sample.ball), torch.atleast_1d(sample.drift)),
        () if sample.row_errors is None else (sample.row_errors.angle,),
        () if saturation is None or sample.corners is None else (sample.corners,),
    )
    clip = None
    if saturation is not None:
        clip = *map(float, saturation.limits), saturation.shape == "norm", float(saturation.dead_speed)
    R = kernel.rows_for(m, paper, clip is not None)
    half_spaces = device.empty((B, R, p), u), device.empty((B, R), u), device.empty((B, R), u, torch.long)
    informative, alarmed, infeasible = (device.empty((B,), u, torch.bool) for _ in range(3))
    judged = informative, alarmed, infeasible
    device.launch("planar.evidence", given, (paper, model.active_tolerance, clip), (half_spaces, judged))
    return Halfspaces(*half_spaces), judged, cache(partial(_details_on_device, model.active_tolerance, sample))


def _details_on_device(tolerance: float, sample: Sample) -> tuple[Tensor, Tensor, KktSolution]:
    (B, m, _), p, u, long = sample.rows.A.shape, sample.C.shape[-1], sample.u, torch.long
    slack, excess = device.empty((B, m), u), device.empty((B, m), u)
    matrices = [device.empty(shape, u) for shape in ((B, 2, p), (B, 2), (B, 2, 2), (B, 2, 2), (B, 2))]
    solved = *matrices, device.empty((B, m), u, torch.bool), *(device.empty((B,), u, long) for _ in range(3))
    rows = sample.rows.A, sample.rows.b, sample.hard, sample.relaxed
    given = rows, (sample.C, sample.d, u), (torch.atleast_2d(sample.bound),)
    device.launch("planar.details", given, (tolerance,), ((slack, excess), solved))
    return slack, excess, KktSolution(*solved)
