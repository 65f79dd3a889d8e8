"""A projection as the last layer of a network: whatever it learns, its outputs keep the constraints."""

import torch
from torch import nn

import torchfsid as fsid

torch.manual_seed(0)

# For each item x a polygon {u : A u <= b(x)}: speeds below 1, and no faster towards a wall at 0 than its distance.
directions = torch.arange(8, dtype=torch.float64) * torch.pi / 4
octagon = torch.stack((directions.cos(), directions.sin()), dim=-1)


def allowed(x: torch.Tensor) -> fsid.Halfspaces:
    """The safe controls at the places x (B, 2)."""
    speed = fsid.Halfspaces(octagon.expand(len(x), 8, 2), torch.ones(len(x), 8))
    wall = fsid.Halfspaces(torch.tensor([[-1.0, 0.0]]).expand(len(x), 1, 2), x[:, :1])
    return fsid.Halfspaces.stack([speed, wall])


class SafePolicy(nn.Module):
    """A small network, then the nearest safe control."""

    def __init__(self) -> None:
        super().__init__()
        self.wish = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 2))
        self.project = fsid.ProjectOnto()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.project(allowed(x), self.wish(x)).point


policy = SafePolicy().double()
adam = torch.optim.Adam(policy.parameters(), lr=1e-2)
for step in range(201):
    x = torch.rand(128, 2, dtype=torch.float64) * torch.tensor([1.0, 2.0]) - torch.tensor([0.0, 1.0])
    expert = 2 * (torch.tensor([0.0, 0.5]) - x)  # it wants to go to a place at the wall, too fast
    loss = (policy(x) - fsid.ProjectOnto()(allowed(x), expert).point).square().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()
    if step % 50 == 0:
        print(f"step {step:3d}: loss {loss.item():.5f}")

x = torch.rand(1000, 2, dtype=torch.float64)
print("unsafe outputs:", int((~allowed(x).contains(policy(x), tolerance=1e-9)).sum()), "of 1000")
