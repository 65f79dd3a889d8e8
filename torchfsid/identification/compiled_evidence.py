"""Evidence by compiled code: when it can be used, and the way of a sample's numbers to the kernels and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

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


Read = tuple[Halfspaces, Any, KktSolution]
"""The half-spaces, the fields of `Evidence` from `informative` to `excess`, and the KKT conditions."""


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
    elif in_space and bool(sample.relaxed.any()):
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
    """What the kernels say of a sample."""
    if sample.rows.dim == 3:
        return compiled_in_space.read(model, sample)
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
    found = kernel.evidence(*map(array, rows + relaxed + others), clip, paper, model.active_tolerance)
    half_spaces, judged, kkt = found
    solved = KktSolution(*map(torch.from_numpy, kkt))
    return Halfspaces(*map(torch.from_numpy, half_spaces)), tuple(map(torch.from_numpy, judged)), solved


def _read_on_device(model: ObservationModel, sample: Sample) -> Read:
    paper, saturation, u = model.kind == "critical_region", model.task.saturation, sample.u
    (B, m, _), p = sample.rows.A.shape, sample.C.shape[-1]
    given = (
        (sample.rows.A, sample.rows.b, sample.hard, sample.relaxed),
        (sample.C, sample.d, u, sample.usable),
        (torch.atleast_2d(sample.bound), torch.atleast_1d(sample.ball), torch.atleast_1d(sample.drift)),
        () if sample.row_errors is None else (sample.row_errors.angle,),
        () if saturation is None or sample.corners is None else (sample.corners,),
    )
    clip = None
    if saturation is not None:
        clip = *map(float, saturation.limits), saturation.shape == "norm", float(saturation.dead_speed)
    R = kernel.rows_for(m, paper, clip is not None)
    real, boolean, long = torch.float64, torch.bool, torch.long
    half_spaces = (((B, R, p), real), ((B, R), real), ((B, R), long))
    judged = (((B,), boolean),) * 3 + (((B, m), real),) * 2
    matrices = ((B, 2, p), real), ((B, 2), real), ((B, 2, 2), real), ((B, 2, 2), real), ((B, 2), real)
    kkt = *matrices, ((B, m), boolean), *(((B,), long),) * 3
    results = [[device.empty(shape, u, dtype) for shape, dtype in part] for part in (half_spaces, judged, kkt)]
    device.launch("planar.evidence", given, (paper, model.active_tolerance, clip), results)
    return Halfspaces(*results[0]), tuple(results[1]), KktSolution(*results[2])
