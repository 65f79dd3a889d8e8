"""Mistakes of type are refused where an object is made, and the message names the argument and what was expected."""

from collections.abc import Callable

import pytest
import torch

import torchfsid as fsid

TASK, WALL = fsid.GoalTask(0.9), fsid.SpeedDisc(1.0)
NOISE = fsid.NoiseBound(0.02)


def prior(*batch: int) -> fsid.FeasibleSet:
    return fsid.FeasibleSet.from_box(-torch.ones(*batch, 2), torch.ones(*batch, 2))


MISTAKES: dict[str, tuple[Callable[[], object], str]] = {
    "a number for a bound": (lambda: fsid.SetMembershipObserver(TASK, [WALL], prior(1), noise=0.02), "NoiseBound"),  # type: ignore[arg-type]
    "a bare barrier": (lambda: fsid.SetMembershipObserver(TASK, WALL, prior(1), noise=NOISE), "barriers: .* a list"),  # type: ignore[arg-type]
    "a bare barrier of a controller": (lambda: fsid.CbfQpController(TASK, WALL), "barriers: .* a list"),  # type: ignore[arg-type]
    "a task among the barriers": (lambda: fsid.CbfQpController(TASK, [TASK]), r"barriers\[0\]: .* a barrier"),  # type: ignore[list-item]
    "a barrier for a task": (lambda: fsid.CbfQpController(WALL, [WALL]), "task: .* a task"),  # type: ignore[arg-type]
    "a number for a class-K function": (lambda: fsid.CollisionAvoidance(1.5, 0.5), "class_k: .* ClassK"),  # type: ignore[arg-type]
    "a word for a gain": (lambda: fsid.ClassK("1.5"), "class_k.gain: .* positive number"),  # type: ignore[arg-type]
    "a distance that there is not": (
        lambda: fsid.CollisionAvoidance(fsid.ClassK(1.0), 0.5, distance="cubed"),  # type: ignore[arg-type]
        "distance: .* 'squared'",
    ),
    "one limit for two axes": (lambda: fsid.SpeedBox(0.8), "limit: .* each axis"),  # type: ignore[arg-type]
    "a text for names": (lambda: fsid.AffineBarrier(torch.eye(2), torch.ones(2), names="ellipse"), "names: .* tuple"),  # type: ignore[arg-type]
    "a text for parameters": (
        lambda: fsid.AffineTask(torch.eye(2), torch.ones(2), parameter_names="ab"),  # type: ignore[arg-type]
        "parameter_names: .* tuple",
    ),
    "a text for a bound": (lambda: fsid.NoiseBound("0.02"), "noise.velocity: .* bound"),  # type: ignore[arg-type]
    "a gain that is none": (lambda: fsid.GoalTask(None), "gain: .* positive number"),  # type: ignore[arg-type]
    "a prior of no batch": (lambda: fsid.SetMembershipObserver(TASK, [WALL], prior(), noise=NOISE), "batch \\(B,\\)"),
    "a box for a prior": (
        lambda: fsid.SetMembershipObserver(TASK, [WALL], (-1, 1), noise=NOISE),  # type: ignore[arg-type]
        "feasible_set: .* FeasibleSet",
    ),
    "a set that there is not": (
        lambda: fsid.SetMembershipObserver(TASK, [WALL], prior(1), kind="inverse", noise=NOISE),  # type: ignore[arg-type]
        "kind: .* 'inverse_optimal'",
    ),
}  # fmt: skip


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_refused_where_it_is_made(mistake: str) -> None:
    make, told = MISTAKES[mistake]
    with pytest.raises(fsid.InputError, match=told):
        make()
