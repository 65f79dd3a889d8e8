"""Arrays of a GPU kernel from their addresses: numbers are handed to a kernel some twenty times faster than arrays.

A kernel turns (address, extents ...) into an array by `real`, `whole`, `short` or `truth`, which say the type of its
entries. Its first index has stride 1, as in Fortran. In numba's simulator the array itself stands for its address.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.extending import intrinsic

from torchfsid.kernels.compiled import SIMULATED, item


def _of(dtype: Any) -> Callable:
    @intrinsic
    def array(typing_context: Any, handed: Any) -> tuple[Any, Callable]:
        kind = types.Array(dtype, len(handed) - 1, "F")

        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            address, *extents = (builder.extract_value(arguments[0], i) for i in range(len(handed)))
            made = context.make_array(kind)(context, builder)
            size = address.type(context.get_abi_sizeof(context.get_data_type(dtype)))
            made.itemsize, strides, count = size, [size], extents[0]
            for extent in extents[1:]:
                strides.append(builder.mul(size, count))
                count = builder.mul(count, extent)
            made.nitems = count
            made.data = builder.inttoptr(address, context.get_value_type(types.CPointer(dtype)))
            for name, values in (("shape", extents), ("strides", strides)):
                packed = getattr(made, name)
                for i, value in enumerate(values):
                    packed = builder.insert_value(packed, value, i)
                setattr(made, name, packed)
            return made._getvalue()

        return kind(handed), build

    return array


@item
def _same(handed: Any) -> Any:
    return handed[0]


real, whole, short, truth = (
    _same if SIMULATED else _of(dtype) for dtype in (types.float64, types.int64, types.int32, types.boolean)
)
