"""Closed loops of planar robots on a GPU: the item functions of `kernels.runs`, one thread a robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import no_type_check

from numba import cuda, float64, int64

from torchfsid.kernels.cuda.launch import Arrays, launch
from torchfsid.kernels.runs import return_one, run_one

Robot = tuple[float, float, tuple[float, bool, float, float]]


def run_to_goals(given: Sequence[Arrays], robot: Robot, results: Sequence[Arrays], stream: int = 0) -> None:
    """Run P x S robots, see `runs.run_to_goals`.

    Args:
        given: (start, goals, bodies).
        robot: the robot's numbers.
        results: (x, u, rows, filled, feasible), to be filled.
        stream: the address of the stream to run on.
    """
    launch(_run(given[0][2].shape[2]), len(results[0][0]), given, robot, results, stream)


def return_to_path(given: Sequence[Arrays], robot: Robot, results: Sequence[Arrays], stream: int = 0) -> None:
    """The vector-Jacobian product of runs, see `runs.return_to_path`.

    Args:
        given: (goals, bodies), the run (x, u, rows, filled, feasible), and (grad_x, grad_u).
        robot: the robot's numbers.
        results: (grad_path,), to be filled.
        stream: the address of the stream to run on.
    """
    launch(_return, len(results[0][0]), given, robot, results, stream)


@cache
def _run(M: int) -> Callable:
    """The kernel for M bodies."""

    @no_type_check
    def run_kernel(scene, run, robot):
        k = cuda.grid(1)
        if k >= run[0].shape[0]:
            return
        of_rows = (
            cuda.local.array((M, 2), float64), cuda.local.array(M, float64), cuda.local.array((M, 2), float64),
            cuda.local.array(M, float64), cuda.local.array(M, float64), cuda.local.array((M, 2), float64),
        )  # fmt: skip
        matrices = (
            cuda.local.array((2, 2), float64), cuda.local.array((2, 2), float64),
            cuda.local.array((2, 2), float64), cuda.local.array((2, 2), float64),
        )  # fmt: skip
        vectors = (
            cuda.local.array(2, float64), cuda.local.array((6, 2), float64), cuda.local.array(2, float64),
            cuda.local.array(2, float64), cuda.local.array(2, float64), cuda.local.array(2, int64),
        )  # fmt: skip
        start, goals, bodies = scene
        run_one(k, start, goals, bodies, robot, run, of_rows + matrices + vectors)

    return cuda.jit(run_kernel)


@no_type_check
def _return_kernel(scene, run, grads, results, robot):
    k = cuda.grid(1)
    if k < run[0].shape[0]:
        goals, bodies = scene
        return_one(k, goals, bodies, robot, run, grads[0], grads[1], results[0])


_return = cuda.jit(_return_kernel)
