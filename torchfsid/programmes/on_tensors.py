"""The functions of `exact` on tensors: by numpy on the CPU, or by kernels on the device that holds them.

On a device the host waits for one number: how many items the device could not verify. These are solved on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfsid import device
from torchfsid.halfspaces import array
from torchfsid.outcome import Status
from torchfsid.programmes import exact

REAL, INDEX, MASK = torch.float64, torch.long, torch.bool


def on_items(of: Callable[..., tuple], A: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    """Apply a function of `exact`, whose arrays have one batch dimension, to tensors with any number of them.

    A is (*batch, m, p). The results are on its device, without gradients.
    """
    batch, where = A.shape[:-2], A.device
    if device.has_kernels(A, *others):
        items = (t.detach().reshape((batch.numel(), *t.shape[len(batch) :])) for t in (A, *others))
        found = ON_DEVICE[of](*items)
        return found if len(batch) == 1 else tuple(part.reshape((*batch, *part.shape[1:])) for part in found)
    arrays = (
        t.detach().cpu().contiguous().numpy().reshape((batch.numel(), *t.shape[len(batch) :])) for t in (A, *others)
    )
    return tuple(torch.from_numpy(array.reshape((*batch, *array.shape[1:]))).to(where) for array in _quiet(of, *arrays))


def _quiet(of: Callable[..., tuple], *arrays: np.ndarray) -> tuple:
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return of(*arrays)


# On a device --------------------------------------------------------------------------------------------------------


def _nearest_point(A: Tensor, b: Tensor, y: Tensor, metric: Tensor | None = None) -> tuple[Tensor, ...]:
    B, p = y.shape
    found = _empty(A, ((B, p), REAL), ((B, p), REAL), ((B, p), INDEX), ((B, p), MASK), ((B,), INDEX))
    given = (A, b, y), _given(metric)
    device.launch("programmes.nearest_point", given, (), (_frame(A, p), found))
    return _verified(exact.nearest_point, sum(given, ()), found)


def _inscribed_ball(A: Tensor, b: Tensor) -> tuple[Tensor, ...]:
    B, _, p = A.shape
    found = _empty(A, ((B, p), REAL), ((B,), REAL), ((B, p + 1), INDEX), ((B,), INDEX))
    device.launch("programmes.inscribed_ball", ((A, b),), (), (_frame(A, p + 1), found))
    return _verified(exact.inscribed_ball, (A, b), found)


def _solve_active(
    N: Tensor, filled: Tensor, pull: Tensor, offsets: Tensor, metric: Tensor | None = None
) -> tuple[Tensor, ...]:
    found = _zeros(N, pull.shape, offsets.shape)
    device.launch("programmes.solve_active", ((N, filled, pull, offsets), _given(metric)), (), (found,))
    return found


def _nearest_point_vjp(A: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    B, m, p = A.shape
    gradients = _zeros(A, (B, m, p), (B, m), (B, p))
    device.launch("programmes.nearest_point_vjp", ((A, *others),), (), (gradients,))
    return gradients


def _inscribed_ball_vjp(A: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    B, m, p = A.shape
    gradients = _zeros(A, (B, m, p), (B, m))
    device.launch("programmes.inscribed_ball_vjp", ((A, *others),), (), (gradients,))
    return gradients


def _verified(of: Callable, given: tuple[Tensor, ...], found: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """The results, with the items that are UNSOLVED replaced by those of the same function of `exact`."""
    lost = (found[-1] == Status.UNSOLVED).nonzero().squeeze(-1)
    if len(lost) > 0:
        again = _quiet(of, *(array(tensor[lost]) for tensor in given))
        for part, solved in zip(found, again, strict=True):
            part[lost] = torch.from_numpy(solved).to(part.device)
    return found


def _frame(A: Tensor, n: int) -> tuple[Tensor, ...]:
    """Scratch for the rows in the frame, n numbers a row."""
    B, m = A.shape[:2]
    return _empty(A, ((B, m, n), REAL), ((B, m), REAL), ((B, m), REAL), ((B, m, 2), REAL))


def _empty(like: Tensor, *parts: tuple[tuple[int, ...], Any]) -> tuple[Tensor, ...]:
    return tuple(device.empty(shape, like, dtype) for shape, dtype in parts)


def _zeros(like: Tensor, *shapes: tuple[int, ...]) -> tuple[Tensor, ...]:
    return tuple(device.empty(shape, like).zero_() for shape in shapes)


def _given(tensor: Tensor | None) -> tuple[Tensor, ...]:
    return () if tensor is None else (tensor,)


ON_DEVICE: dict[Callable[..., tuple], Callable[..., tuple[Tensor, ...]]] = {
    exact.nearest_point: _nearest_point,
    exact.inscribed_ball: _inscribed_ball,
    exact.solve_active: _solve_active,
    exact.nearest_point_vjp: _nearest_point_vjp,
    exact.inscribed_ball_vjp: _inscribed_ball_vjp,
}
"""The function on a device for each one of `exact`."""
