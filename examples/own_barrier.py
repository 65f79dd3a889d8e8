"""A barrier of one's own: keep out of a moving ellipse. Whatever gives rows A u <= b for each robot can be observed."""

import torch

import torchfsid as fsid

# h(x, t) = z' P z - 1 >= 0 outside of the ellipse with half axes 0.8 m and 0.4 m, z = x - c(t), c moving at 0.1 m/s.
# The row says dh/dt >= -gamma h, that is -2 z'P u <= gamma h - 2 z'P dc/dt.
P = torch.diag(torch.tensor([1 / 0.8**2, 1 / 0.4**2], dtype=torch.float64))
VELOCITY = torch.tensor([0.0, 0.1], dtype=torch.float64)
GAMMA = 2.0


def z(seen):
    """The robots' places seen from the centre of the ellipse, (B, 2): rows are made for the whole batch at once."""
    return seen.x - VELOCITY * torch.as_tensor(seen.t).reshape(-1, 1)


def normals(seen):  # A, (B, 1, 2): one row for each robot
    return -2 * (z(seen) @ P).unsqueeze(-2)


def offsets(seen):  # b, (B, 1)
    h = ((z(seen) @ P) * z(seen)).sum(-1) - 1
    return (GAMMA * h - 2 * (z(seen) @ P) @ VELOCITY).unsqueeze(-1)


ellipse = fsid.AffineBarrier(normals, offsets, names=("ellipse",), depends_on_bodies=False)

task, barriers = fsid.GoalTask(gain=1.0), [ellipse, fsid.SpeedBox((1.0, 1.0))]
start = torch.tensor([[-2.0, -0.1], [0.3, 2.0]])
goals = torch.tensor([[2.0, 0.3], [-0.2, -1.5]])
run = fsid.simulate(fsid.CbfQpController(task, barriers), goals, start, dt=0.05, steps=80)

prior = fsid.FeasibleSet.from_box(torch.full((2, 2), -4.0), torch.full((2, 2), 4.0))
observer = fsid.SetMembershipObserver(task, barriers, prior, noise=fsid.NoiseBound(velocity=1e-3))
for measurement in run.measurements():
    estimate = observer.update(measurement)

sets = estimate.feasible_set
print("held by the ellipse in", run.active[..., 0].double().mean(0).mul(100).round().tolist(), "% of the samples")
print("diameters [m]:", sets.diameter().tolist())
print("goals inside:", sets.contains(goals).tolist())
assert sets.contains(goals).all()
