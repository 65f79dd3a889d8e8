"""torchfsid: for each robot of a team, and at every moment, the set in which its hidden task parameter must lie.

After J. Grover, C. Liu, K. Sycara, "Feasible Region-based Identification Using Duality" (called G. throughout).
The names below are the public interface; they load on first use, so that `torchfsid --help` does not wait for PyTorch.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchfsid.active_set import active_set as active_set
    from torchfsid.barriers import AffineBarrier as AffineBarrier
    from torchfsid.barriers import Arena as Arena
    from torchfsid.barriers import ClassK as ClassK
    from torchfsid.barriers import CollisionAvoidance as CollisionAvoidance
    from torchfsid.barriers import SpeedBox as SpeedBox
    from torchfsid.barriers import SpeedPolygon as SpeedPolygon
    from torchfsid.controller import CbfQpController as CbfQpController
    from torchfsid.critical_region import critical_region as critical_region
    from torchfsid.feasible_set import FeasibleSet as FeasibleSet
    from torchfsid.halfspaces import Halfspaces as Halfspaces
    from torchfsid.hybrid import HybridObserver as HybridObserver
    from torchfsid.inverse_optimal import NoiseBound as NoiseBound
    from torchfsid.inverse_optimal import inverse_optimal_set as inverse_optimal_set
    from torchfsid.kkt import solve_kkt as solve_kkt
    from torchfsid.layers import ChebyshevCentre as ChebyshevCentre
    from torchfsid.layers import ProjectOnto as ProjectOnto
    from torchfsid.measurement import Measurement as Measurement
    from torchfsid.neighbours import nearest_bodies as nearest_bodies
    from torchfsid.observer import SetMembershipObserver as SetMembershipObserver
    from torchfsid.simulation import simulate as simulate
    from torchfsid.tasks import AffineTask as AffineTask
    from torchfsid.tasks import FormationTask as FormationTask
    from torchfsid.tasks import GoalTask as GoalTask
    from torchfsid.tasks import OrbitTask as OrbitTask
    from torchfsid.tasks import PatrolTask as PatrolTask
    from torchfsid.tasks import Saturation as Saturation
    from torchfsid.tasks import UnknownGainGoalTask as UnknownGainGoalTask
    from torchfsid.tasks import VelocityTask as VelocityTask
    from torchfsid.ukf import ParameterUkf as ParameterUkf

_HOME = {
    "active_set": ["active_set"],
    "barriers": ["AffineBarrier", "Arena", "ClassK", "CollisionAvoidance", "SpeedBox", "SpeedPolygon"],
    "controller": ["CbfQpController"],
    "critical_region": ["critical_region"],
    "feasible_set": ["FeasibleSet"],
    "halfspaces": ["Halfspaces"],
    "hybrid": ["HybridObserver"],
    "inverse_optimal": ["NoiseBound", "inverse_optimal_set"],
    "kkt": ["solve_kkt"],
    "layers": ["ChebyshevCentre", "ProjectOnto"],
    "measurement": ["Measurement"],
    "neighbours": ["nearest_bodies"],
    "observer": ["SetMembershipObserver"],
    "simulation": ["simulate"],
    "tasks": [
        "AffineTask",
        "FormationTask",
        "GoalTask",
        "OrbitTask",
        "PatrolTask",
        "Saturation",
        "UnknownGainGoalTask",
        "VelocityTask",
    ],
    "ukf": ["ParameterUkf"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = sorted(_MODULE_OF)


class _Package(ModuleType):
    """Importing a submodule binds it to the package's attribute of that name: where a function has the same name as its
    module (`critical_region`, `active_set`), the function is what `torchfsid.critical_region` has to mean."""

    def __setattr__(self, name: str, value: object) -> None:
        if isinstance(value, ModuleType) and _MODULE_OF.get(name) == name:
            value = getattr(value, name)
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'torchfsid' has no attribute {name!r}")
        return getattr(import_module(f"torchfsid.{_MODULE_OF[name]}"), name)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *__all__]


sys.modules[__name__].__class__ = _Package
