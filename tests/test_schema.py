"""`torchfsid schema`: what the command accepts is valid, what it refuses for its form is not."""

import json
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from torchfsid.cli import main
from torchfsid.config.models import load_models
from torchfsid.config.schema import schema
from torchfsid.errors import ConfigError

BASE = """
task: {kind: goal, gain: 0.11}
barriers:
  - {kind: avoidance, safety_distance: 0.15, class_k: {gain: 100.0, power: 3}, neighbour_velocity: current}
prior: {lower: [-1, -1], upper: [1, 1]}
noise: {velocity: 0.02}
"""

RIGHT = {
    "plain": "",
    "limits": "barriers: [{kind: speed_box, limit: [1, 1]}, {kind: speed_polygon, sides: 8, limit: 0.2, soft: true}, "
    "{kind: arena, lower: [-1, -1], upper: [1, 1], class_k: {gain: 1}}, {kind: speed_disc, limit: 1}]",
    "orca": "barriers: [{kind: orca, time_horizon: [1, 6], margin: 0.1, time_step: 0.1, max_speed: 1.0, "
    "neighbours: {count: 10, distance: 10.0}}]",
    "unknown": "barriers: [{kind: avoidance, margin: [0, 0.3], class_k: {gain: [0.5, 50]}, shared: robot}]",
    "forms": "barriers: [{kind: avoidance, safety_distance: 0.2, distance: [squared, euclidean], "
    "neighbour_velocity: auto, class_k: {gain: 2, power: [1, 3]}}]",
    "second order": "{dynamics: double_integrator, task: {kind: goal, gain: 0.6, damping: 1.4}, "
    "noise: {acceleration: auto, velocity: 0.01}, barriers: [{kind: avoidance, order: 2, safety_distance: 0.5, "
    "class_k: [{gain: 1.5}, {gain: 2.0}], neighbour_acceleration: auto}, {kind: acceleration_box, limit: [1, 1]}]}",
    "hypotheses": "{task: null, tasks: [{task: {kind: goal, gain: 1}}, {name: v, task: {kind: velocity}}]}",
    "clipped": "task: {kind: goal, gain: [0.1, 0.3], saturation: {kind: box, limit: [1, 1]}}",
    "bag": "bag: {topics: {/r1/odom: r1}, frames: {base: r2}, radius: {r1: 0.1, r2: 0.1}, rate: 20}",
    "log": "log: {format: columns, time: T, bodies: {a: {x: ax, y: ay}}, unit: mm}",
    "windows": "{velocity: windows, windows: [0.1, 0.5], noise: {velocity: 0.01, position: 0.001}}",
    "others": "{noise: {velocity: auto, slack: 0.1}, ukf: false, obstacles: [1000, wall], "
    "body: {kind: unicycle, map: si_to_uni}, velocity: differentiated}",
    "filter": "ukf: {position_noise: 0.01, feedback: true}",
}

WRONG = {
    "key": "velocty: logged",
    "key below": "noise: {velocty: 0.1}",
    "choice": "velocity: measured",
    "kind": "task: {kind: gaol, gain: 1}",
    "no kind": "task: {gain: 1}",
    "sign": "task: {kind: goal, gain: -1}",
    "word": "noise: {velocity: automatic}",
    "both": "tasks: [{task: {kind: goal, gain: 1}}, {name: v, task: {kind: velocity}}]",
    "neither": "task: null",
    "entries": "barriers: [{kind: speed_box, limit: [1]}]",
    "order": "barriers: [{kind: avoidance, order: 3, safety_distance: 1, class_k: {gain: 1}}]",
    "one form": "barriers: [{kind: avoidance, safety_distance: 1, distance: [squared], class_k: {gain: 1}}]",
}


def changed(change: str) -> dict:
    """The base with these sections replaced. Those that are null are left out."""
    content = {**yaml.safe_load(BASE), **(yaml.safe_load(change) or {})}
    return {key: value for key, value in content.items() if value is not None}


def accepts(content: dict, folder: Path) -> bool:
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(content))
    try:
        load_models(path)
    except ConfigError:
        return False
    return True


@pytest.mark.parametrize("change", RIGHT.values(), ids=RIGHT.keys())
def test_what_is_accepted_is_valid(tmp_path, change):
    content = changed(change)
    assert accepts(content, tmp_path)
    assert [error.message for error in Draft202012Validator(schema()).iter_errors(content)] == []


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_what_is_refused_for_its_form_is_not_valid(tmp_path, change):
    content = changed(change)
    assert not accepts(content, tmp_path)
    assert not Draft202012Validator(schema()).is_valid(content)


def test_it_is_printed_and_explains_the_keys(capsys):
    assert main(["schema"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == schema()
    Draft202012Validator.check_schema(printed)
    assert "[1/s]" in printed["$defs"]["GoalConfig"]["properties"]["gain"]["description"]
    assert "[m]" in printed["$defs"]["AvoidanceConfig"]["properties"]["safety_distance"]["description"]
    assert all("description" in value for value in printed["properties"].values())
