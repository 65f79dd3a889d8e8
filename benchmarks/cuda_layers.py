"""The exact layers on a GPU, forward and backward: a section of `python -m benchmarks cuda`.

Nearest points and largest balls of B sets of m = 24 random half-spaces in p = 2 and 3 dimensions, and the gradients of
a weighted sum of them. In the same run: one CPU core with the same kernels. Results are compared with its results:
statuses, and the largest |difference| / (1 + |result|). The first calls, with the compilation, are not counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np
import torch
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.kernels.active_rows import simplex_around
from torchfsid.kernels.threads import get_num_threads, set_num_threads
from torchfsid.outcome import Status
from torchfsid.programmes.layers import ChebyshevCentre, ProjectOnto

ROWS, DIMENSIONS, SIZES = 24, (2, 3), (4096, 65_536)
WARM, REPEATS = {"cuda": 2, "cpu": 1}, {"cuda": 9, "cpu": 3}
TARGET_BATCH, TARGET = 65_536, 10e-3
"""Forward and backward of this batch take at most this long on an H100 [s]."""

Answer = tuple[Tensor, ...]


def workload(B: int, m: int, p: int) -> list[Tensor]:
    """Bounded sets A z <= b around the origin, b in [0.5, 1.5], and points, most of them outside."""
    rng = np.random.default_rng([B, m, p])
    A = rng.normal(size=(B, m, p))
    A /= np.linalg.norm(A, axis=-1, keepdims=True)
    A[:, : p + 1] = simplex_around(p)[:, :p]
    return [torch.from_numpy(part) for part in (A, rng.uniform(0.5, 1.5, (B, m)), 3 * rng.normal(size=(B, p)))]


def projection(A: Tensor, b: Tensor, y: Tensor) -> Answer:
    return tuple(ProjectOnto()(Halfspaces(A, b), y))


def chebyshev(A: Tensor, b: Tensor, y: Tensor) -> Answer:
    return tuple(ChebyshevCentre()(Halfspaces(A, b)))


def with_gradients(layer: Callable[..., Answer], given: list[Tensor]) -> Answer:
    """The answers, the status last, and the gradients with respect to the rows."""
    leaves = [part.detach().requires_grad_() for part in given]
    found = layer(*leaves)
    weights = torch.arange(1, 1 + found[0].shape[-1], dtype=torch.float64, device=found[0].device)
    total = found[0] @ weights + sum(found[1:-1])
    gradients = torch.autograd.grad(total.sum(), leaves[:2])
    return *(part.detach() for part in found), *gradients


def without_gradients(layer: Callable[..., Answer], given: list[Tensor]) -> Answer:
    with torch.no_grad():
        return layer(*given)


def timed(where: str, step: Callable[[], Answer]) -> tuple[float, Answer]:
    """The median time of a step [s], until the device has done it, and its result."""
    spent, found = [], ()
    for _ in range(WARM[where] + REPEATS[where]):
        began = time.perf_counter()
        found = step()
        if where == "cuda":
            torch.cuda.synchronize()
        spent.append(time.perf_counter() - began)
    return median(spent[WARM[where] :]), found


def one(layer: Callable[..., Answer], B: int, p: int, where: str) -> dict:
    """Times on the device and on one core [s], and how their results differ."""
    on_cpu = workload(B, ROWS, p)
    there = [part.to(where) for part in on_cpu]
    forward, _ = timed(where, partial(without_gradients, layer, there))
    both, found = timed(where, partial(with_gradients, layer, there))
    core_forward, _ = timed("cpu", partial(without_gradients, layer, on_cpu))
    core_both, expected = timed("cpu", partial(with_gradients, layer, on_cpu))
    apart = [
        float(((mine.cpu() - theirs).abs() / (1 + theirs.abs())).max())
        for mine, theirs in zip(found, expected, strict=True)
    ]
    status = len(found) - 3
    return {
        "layer": layer.__name__,
        "items": B,
        "rows": ROWS,
        "dimension": p,
        "forward_s": forward,
        "forward_and_backward_s": both,
        "one_core_forward_s": core_forward,
        "one_core_forward_and_backward_s": core_both,
        "largest_difference": max(apart[:status]),
        "largest_difference_of_gradients": max(apart[status + 1 :]),
        "statuses_that_differ": int((found[status].cpu() != expected[status]).sum()),
        "items_not_ok": int((found[status] != Status.OK).sum()),
    }


def compare(sizes: tuple[int, ...] = SIZES, where: str = "cuda") -> dict:
    """Measure the layers and print what was measured."""
    threads, of_torch = get_num_threads(), torch.get_num_threads()
    set_num_threads(1)
    torch.set_num_threads(1)
    try:
        runs = [run(layer, B, p, where) for B in sizes for p in DIMENSIONS for layer in (projection, chebyshev)]
    finally:
        set_num_threads(threads)
        torch.set_num_threads(of_torch)
    return {"target_s": TARGET, "target_items": TARGET_BATCH, "runs": runs}


def run(layer: Callable[..., Answer], B: int, p: int, where: str) -> dict:
    """One measurement, printed."""
    result = one(layer, B, p, where)
    both, core = result["forward_and_backward_s"], result["one_core_forward_and_backward_s"]
    line = f"  {result['layer']:10s} B = {B:6d}, m = {ROWS}, p = {p}: forward {result['forward_s'] * 1e3:7.2f} ms, "
    line += f"with backward {both * 1e3:7.2f} ms, one core {core * 1e3:7.1f} ms ({core / both:.0f} x)"
    if B == TARGET_BATCH:
        line += f"; target {TARGET * 1e3:.0f} ms: {'met' if both <= TARGET else 'missed'}"
    line += f"; largest difference {result['largest_difference']:.1e}, of gradients "
    line += f"{result['largest_difference_of_gradients']:.1e}, statuses {result['statuses_that_differ']}, "
    print(f"{line}not OK {result['items_not_ok']}", flush=True)
    return result
