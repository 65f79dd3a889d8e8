"""A stand-in for a second device: whatever is created without naming a device lands on another one than the data.

On a machine with an accelerator, a tensor created without `device=` is on the CPU and cannot be mixed with the user's
data. Here the data are on the CPU, and such a tensor is put on `meta`, where mixing it with the data raises just so. As
on an accelerator, scalars (tensors without dimensions) go with anything.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.overrides import TorchFunctionMode

FACTORIES = {
    getattr(torch, name)
    for name in ("arange", "as_tensor", "empty", "eye", "full", "linspace", "ones", "tensor", "triu_indices", "zeros")
}


class ElsewhereMode(TorchFunctionMode):
    """Tensors created without a device, from plain numbers, are elsewhere."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        made = func(*args, **kwargs)
        from_data = any(isinstance(arg, torch.Tensor) for arg in args)
        if func in FACTORIES and kwargs.get("device") is None and made.ndim > 0 and not from_data:
            return made.to("meta")
        return made
