# %% [markdown]
# # The gradient of a set's area
#
# A robot passes a pillar on the way to its goal. How much an observer learns depends on where the pillar stands. The
# area of what is left of the prior is differentiable through the simulation, the observer and the clips: so ask which
# way to move the pillar, and follow the answer.

# %%
import torch

import torchfsid as fsid

task = fsid.GoalTask(gain=0.8)
barrier = fsid.CollisionAvoidance(fsid.ClassK(1.5), safety_distance=0.6)
start, goal = torch.tensor([[-1.5, 0.0]]), torch.tensor([[1.5, 0.1]])


def log_area(pillar: torch.Tensor) -> torch.Tensor:
    """The logarithm of the area in which the goal may lie, after half a second."""
    run = fsid.simulate(fsid.CbfQpController(task, [barrier]), goal, start, obstacles=pillar, dt=0.05, steps=10)
    prior = fsid.FeasibleSet.from_box(torch.full((1, 2), -3.0), torch.full((1, 2), 3.0))
    observer = fsid.SetMembershipObserver(task, [barrier], prior, noise=fsid.NoiseBound(velocity=0.05))
    for measurement in run.measurements():
        estimate = observer.update(measurement)
    return estimate.feasible_set.volume().log().sum()


# %% [markdown]
# First the derivative against a difference quotient, at a place where the pillar holds the robot back.

# %%
pillar = torch.tensor([[-0.6, 0.05]], dtype=torch.float64, requires_grad=True)
(gradient,) = torch.autograd.grad(log_area(pillar), pillar)
step = torch.tensor([[0.0, 1e-6]], dtype=torch.float64)
difference = (log_area(pillar.detach() + step) - log_area(pillar.detach() - step)) / 2e-6
print(f"d log(area) / dy = {gradient[0, 1]:.6f}, by differences {difference:.6f}")

# %% [markdown]
# Now descend. The history of active sets stays the same on the way, so the area is smooth; where it switches, the area
# jumps, and one has to look at a mean over many goals (`docs/design.md`).

# %%
adam = torch.optim.Adam([pillar], lr=0.02)
for k in range(16):
    adam.zero_grad()
    loss = log_area(pillar)
    loss.backward()
    adam.step()
    if k % 5 == 0:
        print(f"step {k:2d}: pillar at ({pillar[0, 0]:.3f}, {pillar[0, 1]:.3f}), area {loss.exp():.4f} m2")
