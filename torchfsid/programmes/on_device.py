"""The functions of `exact` for tensors on a device that has kernels. The results stay there.

The host reads one number: how many items the device could not verify. These are solved again on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchfsid import device
from torchfsid.outcome import Status
from torchfsid.programmes import exact

REAL, INDEX, MASK = torch.float64, torch.long, torch.bool


def nearest_point(A: Tensor, b: Tensor, y: Tensor, metric: Tensor | None = None) -> tuple[Tensor, ...]:
    B, p = y.shape
    found = _empty(A, ((B, p), REAL), ((B, p), REAL), ((B, p), INDEX), ((B, p), MASK), ((B,), INDEX))
    given = (A, b, y), _given(metric)
    device.launch("programmes.nearest_point", given, (), (_frame(A, p), found))
    return _verified(exact.nearest_point, sum(given, ()), found)


def inscribed_ball(A: Tensor, b: Tensor) -> tuple[Tensor, ...]:
    B, _, p = A.shape
    found = _empty(A, ((B, p), REAL), ((B,), REAL), ((B, p + 1), INDEX), ((B,), INDEX))
    device.launch("programmes.inscribed_ball", ((A, b),), (), (_frame(A, p + 1), found))
    return _verified(exact.inscribed_ball, (A, b), found)


def solve_active(
    N: Tensor, filled: Tensor, pull: Tensor, offsets: Tensor, metric: Tensor | None = None
) -> tuple[Tensor, ...]:
    found = _zeros(N, pull.shape, offsets.shape)
    device.launch("programmes.solve_active", ((N, filled, pull, offsets), _given(metric)), (), (found,))
    return found


def nearest_point_vjp(A: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    B, m, p = A.shape
    gradients = _zeros(A, (B, m, p), (B, m), (B, p))
    device.launch("programmes.nearest_point_vjp", ((A, *others),), (), (gradients,))
    return gradients


def inscribed_ball_vjp(A: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    B, m, p = A.shape
    gradients = _zeros(A, (B, m, p), (B, m))
    device.launch("programmes.inscribed_ball_vjp", ((A, *others),), (), (gradients,))
    return gradients


def _verified(of: Callable, given: tuple[Tensor, ...], found: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """The results, with the items that are UNSOLVED replaced by those of the same function of `exact`."""
    lost = (found[-1] == Status.UNSOLVED).nonzero().squeeze(-1)
    if len(lost) > 0:
        again = of(*(tensor[lost].numpy(force=True) for tensor in given))
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
