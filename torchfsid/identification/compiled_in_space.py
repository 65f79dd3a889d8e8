"""Evidence of controls in space by compiled code: a sample's numbers on the way to the kernels and back.

Clipped nominal controls are read in three steps: the half-spaces Q of the clipped control (C = I and d = 0), Q within
the box of the limits, and the half-spaces of the unclipped control.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfsid import device
from torchfsid.halfspaces import Halfspaces, array, dot
from torchfsid.identification.kkt import KktSolution
from torchfsid.identification.saturation import LEAST_LIMIT
from torchfsid.kernels import saturation_in_space as clipped
from torchfsid.kernels.cones import RING
from torchfsid.kernels.evidence_in_space import evidence_in_space, places, rows_for
from torchfsid.robots.tasks import Saturation
from torchfsid.sets.polyhedron import Polyhedron

if TYPE_CHECKING:
    from torchfsid.identification.evidence import ObservationModel, Sample

REAL, BOOL, LONG = torch.float64, torch.bool, torch.long

Read = tuple[Halfspaces, tuple[Tensor, ...], KktSolution]
"""The half-spaces, the fields of `Evidence` from `informative` to `excess`, and the KKT conditions."""


def read(model: ObservationModel, sample: Sample) -> Read:
    """What the kernels say of a sample."""
    saturation = model.task.saturation
    if saturation is None:
        return _read(model, sample)
    C, d = sample.C, sample.d
    known = C.isfinite().all(-1).all(-1) & d.isfinite().all(-1)
    C, d = torch.where(known[:, None, None], C, 0.0), torch.where(known[:, None], d, 0.0)
    identity, no_drift = torch.eye(3, dtype=REAL, device=d.device).expand(len(d), 3, 3), torch.zeros_like(sample.drift)
    of_control = replace(
        sample, C=identity, d=torch.zeros_like(d), usable=sample.usable & known, drift=no_drift, corners=None
    )
    admissible, judged, kkt = _read(model, of_control)
    omega = _unclipped(admissible, saturation, sample, C, d, judged[0])
    return omega, judged, replace(kkt, G=kkt.free @ C, f=kkt.offset + dot(kkt.free, d.unsqueeze(-2)))


def _read(model: ObservationModel, sample: Sample) -> Read:
    """What the kernels say of a sample whose nominal control is not clipped."""
    paper, u, errors = model.kind == "critical_region", sample.u, sample.row_errors
    rows, nominal = (sample.rows.A, sample.rows.b, sample.hard), (sample.C, sample.d, u, sample.usable)
    bounds = torch.atleast_2d(sample.bound), torch.atleast_1d(sample.ball), torch.atleast_1d(sample.drift)
    if not (sample.rows.rows > 0 and device.has_kernels(*rows, *nominal)):
        angle = u[:, :0] if errors is None else errors.angle
        given = *rows, *nominal, bounds[0], angle, *bounds[1:]
        found = evidence_in_space(*map(array, given), paper, model.active_tolerance)
        half_spaces, judged, kkt = (tuple(map(torch.from_numpy, part)) for part in found)
        return Halfspaces(*half_spaces), judged, KktSolution(*kkt)
    (B, m, _), p = sample.rows.A.shape, sample.C.shape[-1]
    R, generators = rows_for(m, paper), m if errors is None or paper else m * RING
    shapes = (
        (((B, R, p), REAL), ((B, R), REAL), ((B, R), LONG)),
        (((B,), BOOL), ((B,), BOOL), ((B,), BOOL), ((B, m), REAL), ((B, m), REAL)),
        (
            ((B, 3, p), REAL), ((B, 3), REAL), ((B, 3, 3), REAL), ((B, 3, 3), REAL), ((B, 3), REAL),
            ((B, m), BOOL), ((B,), LONG), ((B,), LONG), ((B,), LONG),
        ),
    )  # fmt: skip
    half_spaces, judged, kkt = (tuple(device.empty(shape, u, kind) for shape, kind in part) for part in shapes)
    work = device.scratch(places(m, generators), B, u)
    given = rows, nominal, bounds, () if errors is None else (errors.angle,)
    device.launch("space.evidence", given, (paper, model.active_tolerance), (half_spaces, judged, kkt, work))
    return Halfspaces(*half_spaces), judged, KktSolution(*kkt)


def _unclipped(
    admissible: Halfspaces, saturation: Saturation, sample: Sample, C: Tensor, d: Tensor, informative: Tensor
) -> Halfspaces:
    """`identification.saturation.unclipped` and its half-spaces of theta."""
    assert sample.corners is not None
    assert admissible.source is not None
    wishes, margin = sample.corners @ C.mT + d.unsqueeze(-2), torch.atleast_1d(sample.drift)
    farthest = wishes.norm(dim=-1).amax(-1, keepdim=True) + margin.unsqueeze(-1)
    # A limit beyond every possible nominal control is no limit, and may be replaced by any finite one.
    limits = torch.minimum(device.constant(tuple(saturation.limits), d.device), 2 * farthest).clamp(min=LEAST_LIMIT)
    own = Halfspaces(admissible.A, admissible.b)
    stamp, of_box = torch.zeros_like(own.b), torch.zeros_like(admissible.source)
    cut = Polyhedron.from_box(-limits, limits).clip(own.A, own.b, stamp, of_box, own.rows + 6)
    found = admissible.A, admissible.b, admissible.source
    polyhedra, nominal = (cut.body.corners, cut.body.count, cut.outcome, limits), (C, d, wishes, margin)
    no_row, by_norm, dead_speed = 2 * sample.rows.rows, saturation.shape == "norm", float(saturation.dead_speed)
    if not device.has_kernels(own.b, d):
        of_Q, of_cut, of_nominal = (tuple(map(array, part)) for part in (found, polyhedra, nominal))
        of_Q, clip = (*of_Q, no_row), (by_norm, dead_speed)
        rows = clipped.unclipped_in_space(of_Q, of_cut, of_nominal, clip, array(informative))
        return Halfspaces(*map(torch.from_numpy, rows))
    B, R, p = len(d), clipped.rows_for(own.rows), C.shape[-1]
    results = device.empty((B, R, p), d), device.empty((B, R), d), device.empty((B, R), d, LONG)
    work = device.scratch(clipped.places(cut.body.corners.shape[1]), B, d)
    given = found, polyhedra, nominal, (informative,)
    device.launch("space.unclipped", given, (no_row, by_norm, dead_speed), (results, work))
    return Halfspaces(*results)
