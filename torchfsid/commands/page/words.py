"""The verdicts of regions.json in words, with their evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torchfsid.commands.judged_bound import JudgedBound

MEANING = {
    "ok": "No contradiction was seen. That is no proof of the model.",
    "alarm": (
        "A declared row was violated by more than its bound: a barrier or a bound is wrong, and the set is not to be "
        "trusted."
    ),
    "inconsistent": (
        "No parameter explains what was measured: the task, a barrier, the prior or a bound is wrong, or the robot "
        "changed its task. The set is not to be trusted."
    ),
}
"""What a status means."""

Shift = Callable[[float | None], float | None]
"""From a time of the files to one of the page [s]."""


def meaning(status: str, bound: JudgedBound | None) -> str:
    """What a status means. `ok` is never said without a useless bound beside it."""
    if status != "ok" or bound is None or not bound.is_useless:
        return MEANING[status]
    doubt = bound.doubt()
    return f"{MEANING[status]} {doubt[0].upper()}{doubt[1:]}."


def of_bound(bound: JudgedBound | None) -> list[list[str]]:
    """The bound on the errors of controls, a line of the model: its name and value."""
    return [] if bound is None else [["bound on controls", f"{bound.bound:.4g} {bound.unit}, {bound.compared()}"]]


def evidence(region: Mapping[str, Any], shift: Shift) -> list[dict[str, Any]]:
    """What speaks against the model of a robot: a sentence, the moment, and the samples behind it.

    Args:
        region: the robot's entry in regions.json.
        shift: from a time of the files to one of the page.
    """
    found = []
    for event in region.get("events", []):
        samples = [{"t": shift(row.get("time")), "row": row_name(row)} for row in event["rows"]]
        if event["reset"]:
            what = "the set started again from the prior: it was contradicted by"
        elif event["status"] == "alarm":
            what = "violated by more than its bound:"
        else:
            what = "these contradict each other:"
        found.append({"t": shift(event["t"]), "what": what, "samples": samples, "reset": event["reset"]})
    aside = region.get("outliers", {}).get("set_aside", [])
    for sample in aside:
        names = sample.get("constraints") or [row_name({"source": source}) for source in sample["sources"]]
        what = "set aside as an outlier:" if sample["certain"] else "may be the outlier that is set aside:"
        t = shift(sample["t"])
        samples = [{"t": t, "row": name} for name in dict.fromkeys(names)]
        found.append({"t": t, "what": what, "samples": samples, "reset": True})
    return found


def row_name(row: Mapping[str, Any]) -> str:
    """The name of the constraint behind an entry of regions.json, or its number where the file has no names."""
    if "constraint" in row:
        return row["constraint"]
    return "prior" if row["source"] < 0 else f"row {row['source']}"


def of_safety(owner: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """What was learned about safety parameters, of the team or of one robot.

    Args:
        owner: whose they are.
        entry: `safety` of regions.json.
    """
    lines, by_data = [], entry["bounded_by_data"]
    for key, unit in (("gain", ""), ("safety_distance", " m"), ("margin", " m")):
        if key in entry:
            ends = zip(entry[key], by_data[key], strict=True)
            low, high = (f"{end:.4g}{'' if is_found else '*'}" for end, is_found in ends)
            lines.append([key.replace("_", " "), f"{low} to {high}{unit}"])
    return {
        "of": owner,
        "lines": lines,
        "starred": not all(end for ends in by_data.values() for end in ends),
        "speeds": entry["approach_speed"],
        "largest": entry.get("largest_speed"),
    }


def of_refutation(found: Mapping[str, Any], clock: Callable[[float], str]) -> str:
    """One refutation of safety parameters as a sentence.

    Args:
        found: an entry of `refutations` in regions.json.
        clock: a time of the files as text.
    """
    if found["robot"] is None:
        whose = "The team has no safety parameters in common"
    else:
        whose = f"No safety parameters explain {found['robot']}"
    rows = _joined(f"{row['robot']} {row['row']} at {clock(row['time'])}" for row in found["rows"])
    reason = f": these contradict each other: {rows}" if rows else ""
    unexplained = _joined(found["unexplained"])
    left = f" Nothing in the prior explains {unexplained} with those that are left." if unexplained else ""
    return f"{whose}, found at {clock(found['t'])}{reason}.{left}"


def _joined(parts: Any) -> str:
    return ", ".join(dict.fromkeys(parts))


def model(config: Mapping[str, Any]) -> list[list[str]]:
    """The declared model in a few lines, each a name and a value."""
    lines = []
    task = config.get("task")
    if isinstance(task, Mapping):
        told = {key: value for key, value in task.items() if key != "kind" and value and value != "proportional"}
        numbers = [f"{key.replace('_', ' ')} {_short(value)}" for key, value in told.items()]
        lines.append(["task", ", ".join([str(task.get("kind")), *numbers])])
    barriers = config.get("barriers")
    if isinstance(barriers, Sequence):
        lines.append(["barriers", ", ".join(str(barrier.get("kind")).replace("_", " ") for barrier in barriers)])
    if "set" in config:
        lines.append(["set", str(config["set"]).replace("_", " ")])
    return lines


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_short(item)}" for key, item in value.items() if item is not None)
    return str(value)
