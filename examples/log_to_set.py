# %% [markdown]
# # From a log to a set
#
# Four robots cross, around a pillar. The log has their positions and velocities; where each of them wants to go is not
# in it. We know how they are programmed: a task and two barriers.

# %%
from pathlib import Path

import torchfsid as fsid

here = Path(__file__).parent if "__file__" in globals() else Path.cwd()
log = fsid.read_log(here / "data" / "crossing.csv")
print(len(log.t), "samples of", ", ".join(log.bodies))

# %%
result = fsid.observe(
    log,
    task=fsid.GoalTask(gain=0.8),
    barriers=[
        fsid.CollisionAvoidance(fsid.ClassK(2.0), safety_distance=0.5, neighbour_velocity="current"),
        fsid.SpeedBox((0.8, 0.8)),
    ],
    prior={"lower": [-3, -3], "upper": [3, 3]},
    noise=fsid.NoiseBound(velocity=0.01, neighbour_velocity=0.005),
    obstacles=["pillar"],
)
print(result)

# %% [markdown]
# The sets hold the goals. If a point is needed, take the centroid. `ok` means: no contradiction was seen; it is not a
# proof of the model.

# %%
for robot, (x, y), status in zip(result.robots, result.sets.centroid().tolist(), result.status_names, strict=True):
    print(f"{robot} goes to ({x:.3f}, {y:.3f}) m, {status}")

# %% [markdown]
# While the robots hold each other back, their motion says little. Once a robot is free, one sample gives its goal.

# %%
for second, diameters in enumerate(result.over_time("diameter")[::20].tolist()):
    print(f"{second} s:", "  ".join(f"{diameter:.3f} m" for diameter in diameters))

# %% [markdown]
# `save` writes the files of `torchfsid observe`, a figure among them:
#
# ![The final sets over the paths, and their sizes over time](results/regions.png)

# %%
print("saved in", result.save("results"))
