# %% [markdown]
# # From a log to a set
#
# Four robots cross, around a pillar. The log has positions and velocities; where each robot wants to go is not in it.

# %%
from pathlib import Path

import torch

import torchfsid as fsid
from torchfsid.logs.read import read_log

here = Path(__file__).parent if "__file__" in globals() else Path.cwd()
log = read_log(here / "data" / "crossing.csv")
robots = [body for body in log.bodies if body != "pillar"]

# %%
task = fsid.GoalTask(gain=0.8)
barriers = [
    fsid.CollisionAvoidance(fsid.ClassK(2.0), safety_distance=0.5, neighbour_velocity="current"),
    fsid.SpeedBox((0.8, 0.8)),
]
noise = fsid.NoiseBound(velocity=0.01, neighbour_velocity=0.005, position=1e-6)
prior = fsid.FeasibleSet.from_box(torch.full((4, 2), -3.0), torch.full((4, 2), 3.0))
observer = fsid.SetMembershipObserver(task, barriers, prior, noise=noise)
for measurement in log.measurements(robots, ["current"]):
    estimate = observer.update(measurement)

# %%
for i, robot in enumerate(robots):
    x, y = estimate.theta[i].tolist()
    print(f"{robot}: ({x:.3f}, {y:.3f}) m, diameter {estimate.feasible_set.diameter()[i]:.3f} m, {observer.status[i]}")
