"""The item functions of the kernels, launched on a GPU. See `device` for the way of tensors to them."""
