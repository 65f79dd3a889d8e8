"""Where to compute: in torch, or in kernels that numba has compiled (extra `fast`).

Both give the same sets up to round-off, and every function of the plane has both. The kernels compute on the CPU and
give no gradients; a few robots cost them a tenth of torch's time, ten thousand a fraction.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from torchfsid.errors import InputError


@cache
def installed() -> bool:
    """Is numba there?"""
    return find_spec("numba") is not None


def use_kernel(compiled: bool | None, *tensors: Tensor) -> bool:
    """Shall a function of these tensors run compiled? `compiled` is the caller's wish; None: wherever it can.

    Raises:
        InputError: it must, but numba is not installed, or a tensor needs a gradient or is not on the CPU.
    """
    if compiled is False:
        return False
    obstacle = None
    if not installed():
        obstacle = "numba is not installed (pip install 'torchfsid[fast]')"
    elif torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        obstacle = "gradients are required"
    elif not all(tensor.is_cpu for tensor in tensors):
        obstacle = "tensors are not on the CPU"
    if compiled and obstacle is not None:
        raise InputError("compiled", "False or None", f"True, but {obstacle}")
    return obstacle is None


def array(tensor: Tensor) -> np.ndarray:
    """The tensor as the kernels take it: contiguous, without a copy if it is."""
    return (tensor.detach() if tensor.requires_grad else tensor).contiguous().numpy()
