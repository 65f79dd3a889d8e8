"""The barriers in the text of a commented configuration (`starting_config`): one to start from, others as comments."""

from __future__ import annotations

import math

import numpy as np

from torchfsid.commands.survey import Survey
from torchfsid.commands.yaml_lines import coordinates, line, numbers, rounded_down, rounded_up, short

KEPT = 0.95
"""Share of the smallest distance seen that is taken for the safety distance: nearer to it, gains would be infinite."""

STEEPEST = 100.0
"""Gains above this are no barrier's: the bodies touched, or nothing kept them apart [1/s]."""

FAR = 0.5
"""Safety distance where no two bodies met [m]."""


def barrier_lines(seen: Survey) -> list[str]:
    """The section `barriers`."""
    second = seen.log.a is not None
    least = seen.least_gain(_safety_distance(seen))
    least = None if least is None or least > STEEPEST else least
    gain = short(1.0 if least is None else rounded_up(least))
    why = "not known from the log" if least is None else "the smallest that forbids nothing seen"
    lines = [
        line("barriers:", "what it is careful of; the rows of all barriers hold together"),
        line("  - kind: avoidance", "EDIT: a control barrier function; or kind: orca (below)"),
        line("    distance: squared", "h = |dx|^2 - Ds^2" + ("" if second else "; or euclidean, |dx| - Ds")),
        _distance(seen),
    ]
    if second:
        return [
            *lines,
            line("    order: 2", "h'' + (k1 + k2) h' + k1 k2 h >= 0"),
            line(f"    class_k: [{{gain: {gain}}}, {{gain: {gain}}}]", f"EDIT: [1/s] k1, k2; {why}"),
            line("    neighbour_acceleration: current", "EDIT: current: one QP for the team; none: each alone"),
            *_limits(seen),
        ]
    return [
        *lines,
        line(f"    class_k: {{gain: {gain}, power: 1}}", f"EDIT: h' >= -gain h^power; {why}"),
        line("    neighbour_velocity: current", "EDIT: of others, in h': current, previous (one sample ago), none"),
        line("    # soft: true", "the controller may violate these rows"),
        *_unknown(seen),
        *_limits(seen),
    ]


def _margin(seen: Survey) -> float:
    """A margin beside the radii [m]."""
    assert seen.log.radius is not None
    margin = rounded_down(KEPT * max(seen.clearance, 0.0)) if math.isfinite(seen.clearance) else FAR
    return margin if margin + float(seen.log.radius.min()) > 0 else FAR


def _safety_distance(seen: Survey) -> float:
    """A safety distance that was kept [m]. With radii, that of the smallest bodies."""
    if seen.log.radius is not None:
        return _margin(seen) + 2 * float(seen.log.radius.min())
    return rounded_down(KEPT * seen.closest) if 0 < seen.closest < math.inf else FAR


def _distance(seen: Survey) -> str:
    told = f"they came as close as {seen.closest:.4g}" if math.isfinite(seen.closest) else "no two bodies met"
    if seen.log.radius is not None:
        return line(f"    margin: {short(_margin(seen))}", f"EDIT: [m] Ds = both radii + margin; {told}")
    return line(f"    safety_distance: {short(_safety_distance(seen))}", f"EDIT: [m] Ds; {told}")


def _unknown(seen: Survey) -> list[str]:
    """The same barrier with unknown numbers."""
    if seen.log.radius is not None:
        distance = f"margin: {numbers([0.0, max(_margin(seen), 0.1)])}"
    else:
        high = _safety_distance(seen)
        distance = f"safety_distance: {numbers([rounded_down(high / 3), high])}"
    return [
        "  # Gain and distance unknown: bounds, and both are learned with the goals",
        f"  # - {{kind: avoidance, {distance}, class_k: {{gain: [0.1, 50]}}, neighbour_velocity: current}}",
    ]


def _limits(seen: Survey) -> list[str]:
    """Limits of controls, walls, and ORCA, as comments."""
    second, n = seen.log.a is not None, seen.log.x.shape[-1]
    largest = rounded_up(float(np.abs(seen.controls[seen.known]).max(initial=0.0)) or 1.0)
    box = f"  # - {{kind: {'acceleration_box' if second else 'speed_box'}, limit: {numbers([largest] * n)}}}"
    lines = [
        "  # Limits of the controller's QP. One that was never reached may be left out",
        line(box, "the largest seen"),
    ]
    if second or n != 2:
        return lines
    speed, (low, high) = short(rounded_up(seen.fastest or 1.0)), seen.extent
    room = _safety_distance(seen)
    lower, upper = (", ".join(coordinates(corner, room)) for corner in (low - room, high + room))
    walls = f"lower: [{lower}], upper: [{upper}]"
    return [
        *lines,
        line(f"  # - {{kind: speed_disc, limit: {speed}}}", "by norm; or speed_polygon, sides: 8"),
        f"  # - {{kind: arena, {walls}, margin: 0.1, class_k: {{gain: 1.0}}}}    # walls [m]",
        "  # ORCA (RVO2), in place of avoidance; it needs radii of the bodies in the log",
        f"  # - {{kind: orca, time_horizon: 2.0, time_step: {short(seen.step)}, max_speed: {speed}, "
        "neighbours: {count: 10, distance: 10.0}}",
    ]
