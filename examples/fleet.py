"""A fleet: a thousand robots, of which each sees its eight nearest bodies only. One observer, one batch."""

import torch

import torchfsid as fsid

torch.manual_seed(0)
N, DT, STEPS = 1000, 0.05, 20

# Starts on a grid with 1 m between neighbours, each moved by up to 20 cm. Goals within 3 m.
place = torch.arange(N)
x = torch.stack((place % 32, place // 32), dim=-1).double() + 0.4 * torch.rand(N, 2) - 0.2
goals = x + 6 * torch.rand(N, 2) - 3

task = fsid.GoalTask(gain=1.0)
barriers = [fsid.CollisionAvoidance(fsid.ClassK(2.0), safety_distance=0.4), fsid.SpeedDisc(1.0)]
controller = fsid.CbfQpController(task, barriers)
prior = fsid.FeasibleSet.from_box(x - 4, x + 4)
observer = fsid.SetMembershipObserver(task, barriers, prior, noise=fsid.NoiseBound(velocity=2e-3))

for k in range(STEPS):
    # What the robots do: each computes its control among its neighbours.
    u = controller(fsid.nearest_bodies(k * DT, x, count=8), goals).u
    # What the observer sees: velocities that are wrong by up to 1 mm/s. Samples for which a body without a slot could
    # matter are not used.
    error = 1e-3 * (2 * torch.rand(N, 2) - 1) / 2**0.5
    estimate = observer.update(fsid.nearest_bodies(k * DT, x, u + error, count=8))
    x = x + DT * u

sets = estimate.feasible_set
quartiles = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
print("diameters of the sets, quartiles [m]:", [f"{d:.3g}" for d in sets.diameter().quantile(quartiles).tolist()])
print("samples that were not used:", int(observer.skipped.sum()), "of", N * STEPS)
print("goals inside:", int(sets.contains(goals).sum()), "of", N)
print("robots that are not ok:", int((estimate.status != fsid.Status.OK).sum()))
assert sets.contains(goals).all()
