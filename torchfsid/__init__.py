"""torchfsid computes, for each robot of a team and at every time, the set in which its hidden task parameter must lie.

After J. Grover, C. Liu, K. Sycara, "Feasible Region-based Identification Using Duality" (called G. throughout).
The names below are the public interface; they load on first use, so that `torchfsid --help` does not wait for PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.2.0"

if TYPE_CHECKING:
    from torchfsid.commands.functions import check as check
    from torchfsid.commands.functions import observe as observe
    from torchfsid.commands.functions import read_log as read_log
    from torchfsid.commands.observed import Observed as Observed
    from torchfsid.errors import BarrierError as BarrierError
    from torchfsid.errors import ConfigError as ConfigError
    from torchfsid.errors import FsidError as FsidError
    from torchfsid.errors import InconsistentError as InconsistentError
    from torchfsid.errors import InputError as InputError
    from torchfsid.errors import LogError as LogError
    from torchfsid.halfspaces import Halfspaces as Halfspaces
    from torchfsid.identification.active_set import active_set as active_set
    from torchfsid.identification.critical_region import critical_region as critical_region
    from torchfsid.identification.evidence import Evidence as Evidence
    from torchfsid.identification.evidence import ObservationModel as ObservationModel
    from torchfsid.identification.evidence import evidence as evidence
    from torchfsid.identification.inverse_optimal import inverse_optimal_set as inverse_optimal_set
    from torchfsid.identification.kkt import solve_kkt as solve_kkt
    from torchfsid.kernels.threads import get_num_threads as get_num_threads
    from torchfsid.kernels.threads import set_num_threads as set_num_threads
    from torchfsid.logs.log import Log as Log
    from torchfsid.observers.fleet import FleetObserver as FleetObserver
    from torchfsid.observers.hybrid import HybridEstimate as HybridEstimate
    from torchfsid.observers.hybrid import HybridObserver as HybridObserver
    from torchfsid.observers.safety import SafetyObserver as SafetyObserver
    from torchfsid.observers.set_membership import Event as Event
    from torchfsid.observers.set_membership import SetEstimate as SetEstimate
    from torchfsid.observers.set_membership import SetMembershipObserver as SetMembershipObserver
    from torchfsid.observers.ukf import ParameterUkf as ParameterUkf
    from torchfsid.observers.ukf import UkfEstimate as UkfEstimate
    from torchfsid.outcome import Status as Status
    from torchfsid.programmes.layers import ChebyshevCentre as ChebyshevCentre
    from torchfsid.programmes.layers import ProjectOnto as ProjectOnto
    from torchfsid.robots.affine_barrier import AffineBarrier as AffineBarrier
    from torchfsid.robots.avoidance import ClassK as ClassK
    from torchfsid.robots.avoidance import CollisionAvoidance as CollisionAvoidance
    from torchfsid.robots.barriers import Arena as Arena
    from torchfsid.robots.barriers import Barrier as Barrier
    from torchfsid.robots.barriers import SpeedBox as SpeedBox
    from torchfsid.robots.barriers import SpeedPolygon as SpeedPolygon
    from torchfsid.robots.bounds import ErrorBounds as ErrorBounds
    from torchfsid.robots.bounds import NoiseBound as NoiseBound
    from torchfsid.robots.bounds import RowErrors as RowErrors
    from torchfsid.robots.buffered_voronoi import BufferedVoronoi as BufferedVoronoi
    from torchfsid.robots.controller import CbfQpController as CbfQpController
    from torchfsid.robots.ellipsoid import Ellipsoid as Ellipsoid
    from torchfsid.robots.measurement import Measurement as Measurement
    from torchfsid.robots.neighbours import nearest_bodies as nearest_bodies
    from torchfsid.robots.orca import Orca as Orca
    from torchfsid.robots.orca import OrcaController as OrcaController
    from torchfsid.robots.second_order import SecondOrderAvoidance as SecondOrderAvoidance
    from torchfsid.robots.simulation import Trajectory as Trajectory
    from torchfsid.robots.simulation import closed_loop as closed_loop
    from torchfsid.robots.simulation import simulate as simulate
    from torchfsid.robots.speed_disc import SpeedDisc as SpeedDisc
    from torchfsid.robots.tasks import AffineTask as AffineTask
    from torchfsid.robots.tasks import FormationTask as FormationTask
    from torchfsid.robots.tasks import GoalTask as GoalTask
    from torchfsid.robots.tasks import OrbitTask as OrbitTask
    from torchfsid.robots.tasks import PatrolTask as PatrolTask
    from torchfsid.robots.tasks import Saturation as Saturation
    from torchfsid.robots.tasks import Task as Task
    from torchfsid.robots.tasks import UnknownGainGoalTask as UnknownGainGoalTask
    from torchfsid.robots.tasks import VelocityTask as VelocityTask
    from torchfsid.robots.unknown_avoidance import UnknownAvoidance as UnknownAvoidance
    from torchfsid.sets.feasible_set import FeasibleSet as FeasibleSet

_HOME = {
    "commands.functions": ["check", "observe", "read_log"],
    "commands.observed": ["Observed"],
    "errors": ["BarrierError", "ConfigError", "FsidError", "InconsistentError", "InputError", "LogError"],
    "halfspaces": ["Halfspaces"],
    "identification.active_set": ["active_set"],
    "identification.critical_region": ["critical_region"],
    "identification.evidence": ["Evidence", "ObservationModel", "evidence"],
    "identification.inverse_optimal": ["inverse_optimal_set"],
    "identification.kkt": ["solve_kkt"],
    "kernels.threads": ["get_num_threads", "set_num_threads"],
    "logs.log": ["Log"],
    "observers.fleet": ["FleetObserver"],
    "observers.hybrid": ["HybridEstimate", "HybridObserver"],
    "observers.safety": ["SafetyObserver"],
    "observers.set_membership": ["Event", "SetEstimate", "SetMembershipObserver"],
    "observers.ukf": ["ParameterUkf", "UkfEstimate"],
    "outcome": ["Status"],
    "programmes.layers": ["ChebyshevCentre", "ProjectOnto"],
    "robots.affine_barrier": ["AffineBarrier"],
    "robots.avoidance": ["ClassK", "CollisionAvoidance"],
    "robots.barriers": ["Arena", "Barrier", "SpeedBox", "SpeedPolygon"],
    "robots.bounds": ["ErrorBounds", "NoiseBound", "RowErrors"],
    "robots.buffered_voronoi": ["BufferedVoronoi"],
    "robots.controller": ["CbfQpController"],
    "robots.ellipsoid": ["Ellipsoid"],
    "robots.measurement": ["Measurement"],
    "robots.neighbours": ["nearest_bodies"],
    "robots.orca": ["Orca", "OrcaController"],
    "robots.second_order": ["SecondOrderAvoidance"],
    "robots.simulation": ["Trajectory", "closed_loop", "simulate"],
    "robots.speed_disc": ["SpeedDisc"],
    "robots.tasks": [
        "AffineTask",
        "FormationTask",
        "GoalTask",
        "OrbitTask",
        "PatrolTask",
        "Saturation",
        "Task",
        "UnknownGainGoalTask",
        "VelocityTask",
    ],
    "robots.unknown_avoidance": ["UnknownAvoidance"],
    "sets.feasible_set": ["FeasibleSet"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'torchfsid' has no attribute {name!r}")
    value = getattr(import_module(f"torchfsid.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
