"""A stand-in for a GPU: tensors that say they are on CUDA, with their numbers on the CPU. Mixing both kinds raises.

It is for a process with NUMBA_ENABLE_CUDASIM=1, where code takes the ways that it takes on a device, and kernels run.
Unlike in `devices`, arrays of numpy that have become tensors are noticed, too. As on a GPU, scalars on the CPU go with
anything, and places on the CPU may index.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from torchfsid import device

FAR = torch.device("meta")
"""The device's name for torch, which needs one that it can compute gradients for without a GPU."""

INDEXED = {"index", "index_put", "index_put_"}


class Far(Tensor):
    """A tensor on the stand-in."""

    is_cuda, is_cpu, is_meta = True, False, False
    near: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, near: Tensor) -> Far:
        made = Tensor._make_wrapper_subclass(cls, near.size(), near.stride(), dtype=near.dtype, device=FAR)  # type: ignore[attr-defined]
        made.near = near
        return made

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(operation, args, kwargs or {})

    def tolist(self) -> Any:
        return self.near.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        assert force, "the numbers of a device, without a copy"
        return self.near.detach().numpy()


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(operation, args, kwargs or {})


def _computed(operation: Any, args: Any, kwargs: dict) -> Any:
    """The result of an operation, on the device of its arguments, or on the one that is asked for."""
    name, place = operation.__name__.split(".")[0], kwargs.get("device")
    tensors = [part for part in tree_leaves((args, kwargs)) if isinstance(part, Tensor)]
    far = [part for part in tensors if isinstance(part, Far)]
    others = [part for part in tensors if not isinstance(part, Far) and part.ndim > 0]
    if name in INDEXED and isinstance(args[0], Far):
        others = [part for part in others if not any(part is index for index in args[1])]
    if far and others and name != "copy_":
        raise RuntimeError(f"{operation} mixes tensors on the device and on the CPU")
    if place is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    made = operation(*tree_map(_near, args), **tree_map(_near, kwargs))
    known = {id(part.near): part for part in far} | {id(part): part for part in tensors}
    is_far = bool(far) if place is None else torch.device(place) == FAR

    def returned(part: Any) -> Any:
        return known.get(id(part), Far(part) if is_far else part) if isinstance(part, Tensor) else part

    return tree_map(returned, made)


def _near(part: Any) -> Any:
    return part.near if isinstance(part, Far) else part


@contextmanager
def far_device() -> Iterator[None]:
    """Within it, `FAR` is the device. Tensors get there by `to(FAR)`."""
    tensor = torch.tensor

    def made(values: Any, *, dtype: torch.dtype | None = None, device: Any = None) -> Tensor:
        """`torch.tensor`, which gives no numbers to tensors on meta."""
        found = values if isinstance(values, Tensor) else tensor(values, dtype=dtype)
        return found.to(found.device if device is None else device, dtype or found.dtype)

    def array(part: Tensor) -> Any:
        assert isinstance(part, Far), "a kernel gets a tensor on the CPU"
        return part.near.detach().numpy()

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(torch, "tensor", made)
        patched.setattr(torch, "as_tensor", made)
        patched.setattr(Tensor, "new_tensor", lambda like, values: made(values, dtype=like.dtype, device=like.device))
        patched.setattr(device, "_array", array)
        device._kept.cache_clear()
        with _Mode():
            yield
        device._kept.cache_clear()
