"""A ROS 2 bag in, an MCAP file out, for Foxglove, RViz and rerun. No ROS is needed: pip install 'torchfsid[ros]'.

The bag is recorded here from a simulated run, three robots with nav_msgs/Odometry; yours comes from `ros2 bag record`.
"""

from pathlib import Path

import numpy as np
import torch
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import torchfsid as fsid
from torchfsid.cli import main

store = get_typestore(Stores.ROS2_HUMBLE)
GEOMETRY = "geometry_msgs/msg/"


def make(kind, *values):
    return store.types[kind](*values)


def odometry(t, x, u):
    """Position and velocity at t [s], in the frame map. A covariance of zeros says nothing."""
    header = make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", int(t), round(t % 1 * 1e9)), "map")
    place, turn = make(f"{GEOMETRY}Point", *x.tolist(), 0.0), make(f"{GEOMETRY}Quaternion", 0.0, 0.0, 0.0, 1.0)
    velocity, still = make(f"{GEOMETRY}Vector3", *u.tolist(), 0.0), make(f"{GEOMETRY}Vector3", 0.0, 0.0, 0.0)
    pose = make(f"{GEOMETRY}PoseWithCovariance", make(f"{GEOMETRY}Pose", place, turn), np.zeros(36))
    twist = make(f"{GEOMETRY}TwistWithCovariance", make(f"{GEOMETRY}Twist", velocity, still), np.zeros(36))
    return make("nav_msgs/msg/Odometry", header, "base_link", pose, twist)


controller = fsid.CbfQpController(fsid.GoalTask(0.8), [fsid.CollisionAvoidance(fsid.ClassK(2.0), safety_distance=0.5)])
start = torch.tensor([[-2.0, -0.4], [2.0, 0.1], [0.5, -2.0]])
run = fsid.simulate(controller, torch.tensor([[1.8, 0.5], [-1.9, -0.3], [0.1, 1.7]]), start, dt=0.05, steps=60)
with Writer("team", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
    topics = [bag.add_connection(f"/r{i}/odom", "nav_msgs/msg/Odometry", typestore=store) for i in (1, 2, 3)]
    for t, x, u in zip(run.t.tolist(), run.x, run.u, strict=True):
        for topic, of_robot in zip(topics, zip(x, u, strict=True), strict=True):
            bag.write(topic, int(t * 1e9), store.serialize_cdr(odometry(t, *of_robot), "nav_msgs/msg/Odometry"))

Path("team.yaml").write_text("""
bag: {topics: {/r1/odom: r1, /r2/odom: r2, /r3/odom: r3}}
task: {kind: goal, gain: 0.8}
barriers: [{kind: avoidance, safety_distance: 0.5, class_k: {gain: 2.0}}]
prior: {lower: [-3, -3], upper: [3, 3]}
noise: {velocity: 0.001}
""")
assert main(["observe", "team", "--config", "team.yaml", "--out", "results", "--mcap", "seen.mcap", "--merge"]) == 0
with Reader(Path("seen.mcap")) as seen:
    print(*sorted({f"{connection.topic:28s} {connection.msgtype}" for connection in seen.connections}), sep="\n")
