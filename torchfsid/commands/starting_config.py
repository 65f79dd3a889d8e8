"""The text of a commented configuration for a log: every key with its meaning in a line, guesses filled in.

What no log can tell, the task and the barriers, has a value to start from and is marked EDIT. The file can be used as
it is. `survey` says how the guesses are made.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchfsid import __version__
from torchfsid.commands.survey import Survey
from torchfsid.logs.recognise import Recognised

COLUMN = 48
"""Where comments begin."""

AROUND = 0.5
"""Share of the larger side of the box in which bodies moved that is added on each side of the prior."""

OWN_ERROR = 0.01
"""Share of the typical speed that controllers are wrong by, to start from, where positions are measured."""


def starting_config(path: Path, out: Path, found: Recognised, seen: Survey) -> str:
    """The content of the file."""
    parts = [
        _head(path, out, found, seen),
        _task(seen),
        _barriers(seen),
        _prior(seen),
        _motion(found, seen),
        _noise(seen),
        _bodies(seen),
        _where(found, seen),
        _rest(),
    ]
    return "\n".join("\n".join(part) + "\n" for part in parts if part)


def _head(path: Path, out: Path, found: Recognised, seen: Survey) -> list[str]:
    log, names = seen.log, ", ".join(seen.log.bodies[:12]) + (", .." if len(seen.log.bodies) > 12 else "")
    low, high = seen.extent
    axes = "xyz"[: len(low)]
    box = ", ".join(f"{axis} {a:.4g} .. {b:.4g}" for axis, a, b in zip(axes, low, high, strict=True))
    unit = "m/s2" if log.a is not None else "m/s"
    lines = [
        f"# Written by torchfsid init {__version__} for {path.name}: {found.what}",
        f"#   bodies        {len(log.bodies)}: {names}",
        f"#   times         {len(log.t)}, {log.t[0]:.6g} to {log.t[-1]:.6g} s, every {seen.step:.4g} s",
        f"#   positions     {box} m; closest to each other {seen.closest:.3g} m",
        f"#   {'accelerations' if log.a is not None else 'speeds       '} up to {seen.fastest:.3g}, "
        f"typically {seen.typical:.3g} {unit}",
    ]
    if max(high - low) > 1000 and found.bag is None:
        lines.append(
            "#   Are these metres? Positions of other units need a section log: {format: columns, unit: mm, ..}"
        )
    return [
        *lines,
        "#",
        "# Edit the lines marked EDIT: no log tells what robots want, or how they avoid each other. Then ask whether",
        "# the log fits this model, and for the sets:",
        f"#   torchfsid check {path} --config {out}",
        f"#   torchfsid observe {path} --config {out} --out results",
        "# Editors with yaml-language-server complete and check the keys if you run",
        "#   torchfsid schema > torchfsid.schema.json",
        "# and make this the first line:",
        "#   # yaml-language-server: $schema=torchfsid.schema.json",
    ]


def _task(seen: Survey) -> list[str]:
    second, guess = seen.log.a is not None, seen.goal
    gain = 1.0 if guess is None else guess.gain
    why = "not known from the log" if guess is None else "guessed from the second half"
    unit = "1/s2" if second else "1/s"
    rule = "uhat = gain (theta - x)" + (" - damping v" if second else "")
    lines = [
        _line("task:", "what a robot wants; theta is what it tells nobody"),
        _line("  kind: goal", "EDIT: or velocity, formation, orbit, patrol, goal_unknown_gain"),
        _line(f"  gain: {_short(gain)}", f"EDIT: [{unit}] {rule}; {why}"),
    ]
    if not seen.is_restless:
        lines.append(_line(f"  # gain: [{_short(gain / 3)}, {_short(gain * 3)}]", "or bounds, with a number for noise"))
    if second:
        damping = 2 * math.sqrt(gain) if guess is None or guess.damping is None else guess.damping
        lines.append(_line(f"  damping: {_short(damping)}", f"EDIT: [1/s]; {why}"))
        lines.append(_line("  # velocity_loop: 1.0", "instead of damping: uhat = velocity_loop (gain (theta - x) - v)"))
        return lines
    clipped = f"saturation: {{kind: norm, limit: {_short(seen.fastest or 1.0)}}}"
    if seen.limited == "disc":
        lines.append(
            _line(f"  {clipped}", "EDIT: [m/s] uhat is clipped (so many commands are that fast); or kind: box")
        )
    else:
        lines.append(_line(f"  # {clipped}", "[m/s] uhat is clipped to this speed; or kind: box, limit: [x, y]"))
    lines.append(_line("  # dead_zone: 0.05", "[m] nearer to the goal than this the robot stops"))
    return lines


def _barriers(seen: Survey) -> list[str]:
    log = seen.log
    second, n = log.a is not None, log.x.shape[-1]
    lines = [_line("barriers:", "what it is careful of; the rows of all barriers hold together")]
    lines.append(_line("  - kind: avoidance", "EDIT: a control barrier function; or kind: orca (below)"))
    lines.append(_line("    distance: squared", "h = |dx|^2 - Ds^2" + ("" if second else "; or euclidean, |dx| - Ds")))
    closest = seen.closest if math.isfinite(seen.closest) else 0.5
    if log.radius is not None:
        both = 2 * float(log.radius.max())
        margin = max(_rounded_down(closest - both), 0.0) if closest > both else 0.0
        margin = margin if margin + float(log.radius.min()) > 0 else _rounded_down(closest)
        lines.append(
            _line(
                f"    margin: {_short(margin)}",
                f"EDIT: [m] Ds = both radii + margin; they came as close as {closest:.4g}",
            )
        )
    else:
        lines.append(
            _line(
                f"    safety_distance: {_short(_rounded_down(closest))}",
                f"EDIT: [m] Ds; they came as close as {closest:.4g}",
            )
        )
    if second:
        lines.append(_line("    order: 2", "h'' + (k1 + k2) h' + k1 k2 h >= 0"))
        lines.append(_line("    class_k: [{gain: 1.0}, {gain: 1.0}]", "EDIT: [1/s] k1, k2"))
        lines.append(
            _line("    neighbour_acceleration: current", "EDIT: current: one QP for the team; none: each alone")
        )
    else:
        lines.append(_line("    class_k: {gain: 1.0, power: 1}", "EDIT: h' >= -gain h^power"))
        lines.append(
            _line("    neighbour_velocity: current", "EDIT: of others, in h': current, previous (one sample ago), none")
        )
        lines.append(_line("    # soft: true", "the controller may violate these rows"))
        lines.append("  # Gain and distance unknown: bounds, and both are learned with the goals")
        name = "margin" if log.radius is not None else "safety_distance"
        low, high = (0.0, max(margin, 0.1)) if log.radius is not None else (closest / 3, closest)
        lines.append(
            f"  # - {{kind: avoidance, {name}: {_list([_rounded_down(low), _rounded_down(high)])}, "
            "class_k: {gain: [0.1, 50]}, neighbour_velocity: current}"
        )
    limit = ", ".join([_short(_rounded_up(float(np.abs(seen.controls[seen.known]).max(initial=0.0)) or 1.0))] * n)
    name = "acceleration_box" if second else "speed_box"
    lines.append("  # Limits of the controller's QP. One that was never reached may be left out")
    lines.append(_line(f"  # - {{kind: {name}, limit: [{limit}]}}", "per axis; the largest seen"))
    if not second and n == 2:
        speed = _short(_rounded_up(seen.fastest or 1.0))
        lines.append(_line(f"  # - {{kind: speed_disc, limit: {speed}}}", "by norm; or speed_polygon, sides: 8"))
        low, high = seen.extent
        walls = f"lower: {_list(low - closest)}, upper: {_list(high + closest)}"
        lines.append(f"  # - {{kind: arena, {walls}, margin: 0.1, class_k: {{gain: 1.0}}}}    # walls [m]")
        lines.append("  # ORCA (RVO2), in place of avoidance; it needs radii of the bodies in the log")
        lines.append(
            f"  # - {{kind: orca, time_horizon: 2.0, time_step: {_short(seen.step)}, max_speed: {speed}, "
            "neighbours: {count: 10, distance: 10.0}}"
        )
    return lines


def _prior(seen: Survey) -> list[str]:
    low, high = seen.extent
    around = AROUND * max(float((high - low).max()), 1e-3)
    return [
        _line("prior:", "a box that surely holds every theta; too small a one loses goals"),
        _line(f"  lower: {_list(low - around)}", "EDIT: [m] where bodies were, and half of that around"),
        f"  upper: {_list(high + around)}",
    ]


def _motion(found: Recognised, seen: Survey) -> list[str]:
    log = seen.log
    if log.a is not None:
        return [
            _line("dynamics: double_integrator", "ax, ay are the commands; or single_integrator: vx, vy are"),
            _line("velocity: logged", "commands are those of the log; or differentiated, from velocities"),
        ]
    if seen.is_unicycle:
        heading = found.heading or "heading"
        return [
            _line("velocity: differentiated", "commands are recovered from poses"),
            _line("body:", "they drive along their headings: unicycles"),
            "  kind: unicycle",
            *([_line(f"  heading: {_name(heading)}", "the column [rad]")] if found.heading else []),
            _line("  map: si_to_uni", "EDIT: from commands to wheels; or look_ahead with distance: 0.05"),
            _line("  linear_gain: 1.0", "EDIT: forward speed / share of the command along the heading"),
            _line("  # angular_limit: 3.14159265", "[rad/s] turn rate where the command is across; default pi"),
            _line("  # wheel_limit: 0.2", "[m/s] with wheel_base: 0.11 [m]; samples at the limit are not used"),
        ]
    if log.u is not None:
        also = [
            _line("# dynamics: double_integrator", "if (vx, vy) are states: with velocity: differentiated, order: 2")
        ]
        return [_line("velocity: logged", "(vx, vy) at t is the command; or differentiated, or windows"), *also]
    if seen.is_restless:
        return [
            _line("velocity: windows", "positions only, and measured: means over windows of time"),
            _line("# windows: [0.1, 0.25, 0.5, 1.0]", "[s] their lengths; these are the default"),
        ]
    return [_line("velocity: differentiated", "positions only: differences; windows if positions are measured")]


def _noise(seen: Survey) -> list[str]:
    rounding = "rounded digits of the log are added by themselves"
    position = _short(_rounded_up(5 / 3 * seen.jitter)) if seen.jitter > 0 else "0.0"
    lines = [_line("noise:", "the largest errors, not the typical ones")]
    if seen.log.a is not None:
        lines.append(_line("  acceleration: auto", "[m/s2] of commands: found from the log; or a number"))
        lines.append(_line("  # velocity: 0.01", f"[m/s] of velocities; {rounding}"))
    elif seen.is_restless and not seen.is_unicycle:
        speed = _short(_rounded_up(OWN_ERROR * (seen.typical or 1.0)))
        lines.append(_line(f"  velocity: {speed}", "EDIT: [m/s] of the controllers alone: 1 % of the typical speed"))
        lines.append(_line(f"  position: {position}", "EDIT: [m] of positions: five deviations of the jitter seen"))
        return lines
    else:
        lines.append(_line("  velocity: auto", "[m/s] of commands: found from the log; or a number"))
    lines.append(_line("  # position: 0.001", f"[m] of positions; {rounding}"))
    lines.append(_line("  # slack: 0.05", "of rows, which decides what may be active; default: that of commands"))
    if seen.is_unicycle:
        lines.append(_line("  # heading: 0.005", "[rad] of headings"))
    elif seen.log.a is None:
        lines.append(_line("  # neighbour_velocity: 0.01", "[m/s] of velocities that rows use of other bodies"))
    return lines


def _bodies(seen: Survey) -> list[str]:
    _, still = seen.names
    listed = f"[{', '.join(map(_name, still))}]"
    told = "never moved: avoided, not inferred" if still else "bodies that are avoided but not inferred"
    return [_line(f"obstacles: {listed}", told)]


def _where(found: Recognised, seen: Survey) -> list[str]:
    bodies = [_name(body) for body in seen.log.bodies]
    radius = f"  # radius: {{{', '.join(f'{body}: 0.1' for body in bodies)}}}    # [m], for margin: and orca"
    if found.bag is not None:
        explained = {
            "topics": "topic: name of the body",
            "frames": "frame: name of the body",
            "accelerations": "topic of its commands: body",
            "fixed_frame": "positions are seen from this frame, along chains of transforms",
        }
        rate = f"  # rate: {1 / seen.step:.4g}"
        return [
            _line("bag:", "where the bodies are"),
            *_section(found.bag, explained),
            _line(rate, "[Hz] a common clock, if stamps differ; default: stamps of the first body"),
            _line(
                "  # covariance_multiple: 3", "deviations of Odometry's covariances that bound errors; default: none"
            ),
            radius,
        ]
    if found.form is not None:
        explained = {
            "format": "optitrack, vicon, tum, or columns: any table by the names of its columns",
            "time": "column of times",
            "time_unit": "of that column: s, ms, us, ns",
            "header_line": "line with the names of the columns",
            "unit": "of lengths: m, cm, mm",
            "bodies": "body: its columns",
        }
        lines = [_line("log:", "the form of the log"), *_section(found.form, explained)]
        if found.form["format"] != "columns":
            lines.append(_line('  # bodies: {r1: "Rigid Body 1"}', "takes some and names them; default: all"))
        if "unit" not in found.form:
            lines.append(_line("  # unit: mm", "of lengths: m, cm, mm; default: what the file says, otherwise m"))
        return [*lines, _line("  # up: y", "axis that points up; default: y for optitrack, otherwise z"), radius]
    return []


def _rest() -> list[str]:
    return [
        "# Everything below is a default",
        _line("set: inverse_optimal", "sound under errors; or critical_region, the paper's, for exact data"),
        _line("# active_tolerance: 0.001", "[m/s] of critical_region: nearer to a row than this it is active"),
        _line("on_inconsistent: hold", "or reset (robots that change their goals), or raise"),
        _line("outliers: 0", "samples per robot that may be left unexplained"),
        _line("# ukf: false", "leave the Kalman filter and the hybrid out: faster"),
    ]


def _line(text: str, comment: str) -> str:
    return f"{text:<{COLUMN}}# {comment}" if len(text) < COLUMN else f"{text}    # {comment}"


def _section(content: Mapping[str, Any], explained: Mapping[str, str]) -> list[str]:
    lines = []
    for key, value in content.items():
        if isinstance(value, Mapping):
            lines.append(_line(f"  {key}:", explained[key]))
            lines += [f"    {_name(name)}: {_flow(entry)}" for name, entry in value.items()]
        else:
            lines.append(_line(f"  {key}: {_flow(value)}", explained[key]))
    return lines


def _flow(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_flow(entry)}" for key, entry in value.items()) + "}"
    return _name(value) if isinstance(value, str) else str(value)


def _name(text: str) -> str:
    """A text as YAML, in quotes unless it is a plain word."""
    plain = text.isascii() and text.replace("_", "").isalnum() and text[0].isalpha()
    return (
        text
        if plain and text.lower() not in {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
        else _quoted(text)
    )


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=not text.isprintable())


def _list(values: Iterable[float]) -> str:
    return f"[{', '.join(_short(float(value)) for value in values)}]"


def _short(value: float) -> str:
    """A number of at most four digits, as YAML 1.1 reads it."""
    text = f"{value:.4g}"
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _rounded_down(value: float) -> float:
    """A positive number, rounded down to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return math.floor(value / step * (1 + 1e-6)) * step


def _rounded_up(value: float) -> float:
    """A positive number, rounded up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return math.ceil(value / step * (1 - 1e-6)) * step
