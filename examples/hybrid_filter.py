"""A filter kept honest by a set: the hybrid observer projects the filter's estimate onto what is possible.

Two robots meet head on. While each holds the other back, their motion says little about their goals: the filter is far
off, and the set tells how far it can be.
"""

import torch

import torchfsid as fsid

task, barriers = fsid.GoalTask(gain=0.9), [fsid.CollisionAvoidance(fsid.ClassK(1.5), safety_distance=0.5)]
start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]])
goals = torch.tensor([[2.0, 0.1], [-2.0, 0.0]])
run = fsid.simulate(fsid.CbfQpController(task, barriers), goals, start, dt=0.05, steps=60)

lower, upper = torch.full((2, 2), -5.0), torch.full((2, 2), 5.0)
sets = fsid.SetMembershipObserver(
    task, barriers, fsid.FeasibleSet.from_box(lower, upper), noise=fsid.NoiseBound(velocity=0.02)
)
ukf = fsid.ParameterUkf(
    task,
    barriers,
    mean=torch.tensor([[-1.0, 3.0], [1.0, -3.0]]),
    spread=torch.full((2, 2), 2.0),
    position_noise=0.02,  # standard deviation of a position [m]
    process_noise=1e-4,  # drift of the goal [m per sqrt(s)]
)
observer = fsid.HybridObserver(sets, ukf)

draw = torch.Generator().manual_seed(3)
print("   t   error of the filter, of the hybrid [m]   diameter of the set [m]    (robot 0)")
for k, (t, x, u) in enumerate(zip(run.t, run.x, run.u, strict=True)):
    noisy = u + 0.014 * (2 * torch.rand(u.shape, generator=draw) - 1)
    estimate = observer.update(fsid.Measurement.of_team(float(t), x, noisy))
    if k % 10 == 0:
        filtered = (estimate.ukf_estimate.theta - goals).norm(dim=-1)[0]
        hybrid = (estimate.theta - goals).norm(dim=-1)[0]
        diameter = estimate.set_estimate.feasible_set.diameter()[0]
        print(f"{t:5.2f} {filtered:12.3f} {hybrid:20.3f} {diameter:22.3f}")

possible = estimate.set_estimate.feasible_set
assert possible.contains(goals).all()
assert possible.contains(estimate.theta, tolerance=1e-6).all()
