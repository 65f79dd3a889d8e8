"""Which task do the robots have? Each hypothesis has sets of its own, and one whose set becomes empty is refuted.

The log is data/crossing.csv: four robots that go to goals. A hypothesis that is left is possible, not proven.
"""

from pathlib import Path

import torch

import torchfsid as fsid

log = fsid.read_log(Path(__file__).parent / "data" / "crossing.csv")
robots = [body for body in log.bodies if body != "pillar"]
barriers = [
    fsid.CollisionAvoidance(fsid.ClassK(2.0), safety_distance=0.5, neighbour_velocity="current"),
    fsid.SpeedBox((0.8, 0.8)),
]
noise = fsid.NoiseBound(velocity=0.01, neighbour_velocity=0.005, position=1e-6)  # the log has six decimals

box = torch.full((len(robots), 2), 3.0)
hypotheses = {
    "goal, gain 0.8": fsid.GoalTask(gain=0.8),
    "goal, gain 0.5": fsid.GoalTask(gain=0.5),
    "a constant velocity": fsid.VelocityTask(),
    "an orbit, 0.5 rad/s": fsid.OrbitTask(rate=0.5),
}
observers = {
    name: fsid.SetMembershipObserver(task, barriers, fsid.FeasibleSet.from_box(-box, box), noise=noise)
    for name, task in hypotheses.items()
}
for measurement in log.measurements(robots, ["current"]):
    for observer in observers.values():
        observer.update(measurement)

for name, observer in observers.items():
    refuted = {event.robot: event.t for event in observer.events if event.status == fsid.Status.INCONSISTENT}
    said = [
        f"{robot} refuted at {refuted[i]:.2f} s" if i in refuted else f"{robot} possible"
        for i, robot in enumerate(robots)
    ]
    print(f"{name:20s}", "; ".join(said))
