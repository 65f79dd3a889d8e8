"""The text of a commented configuration for a log: every key with its meaning in a line, guesses filled in.

What no log can tell, the task and the barriers, has a value to start from and is marked EDIT. The file can be used as
it is. `survey` says how the guesses are made.
"""

from __future__ import annotations

import math
from pathlib import Path

from torchfsid import __version__
from torchfsid.commands.starting_barriers import barrier_lines
from torchfsid.commands.survey import Survey
from torchfsid.commands.yaml_lines import coordinates, line, rounded_up, section, short, word
from torchfsid.logs.recognise import Recognised

AROUND = 0.5
"""Share of the larger side of the box in which bodies moved that is added on each side of the prior."""

LEAST = 1e-3
"""Size of the box from which the prior is made [m], where bodies stay in one place."""

OWN_ERROR = 0.01
"""Share of the typical speed that controllers are wrong by, to start from, where positions are measured."""


def starting_config(path: Path, out: Path, found: Recognised, seen: Survey) -> str:
    """The content of the file."""
    parts = [
        _head(path, out, found, seen),
        _task(seen),
        barrier_lines(seen),
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
    size = max(float((high - low).max()), LEAST)
    ends = zip(axes, coordinates(low, size), coordinates(high, size), strict=True)
    box = ", ".join(f"{axis} {a} .. {b}" for axis, a, b in ends)
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
        *map(_in_one_line, lines),
        "#",
        "# Edit the lines marked EDIT: no log tells what robots want, or how they avoid each other. Then ask whether",
        "# the log fits this model, and for the sets:",
        f"#   torchfsid check {path} --config {out}",
        f"#   torchfsid observe {path} --config {out} --out results",
        "# The value of a key with which the log fits best: add --scan barriers.0.class_k.gain=0.1:50 to check.",
        "# Editors with yaml-language-server complete and check the keys if you run",
        "#   torchfsid schema > torchfsid.schema.json",
        "# and make this the first line:",
        "#   # yaml-language-server: $schema=torchfsid.schema.json",
    ]


def _in_one_line(text: str) -> str:
    """The text without line breaks, which would end a comment: names of bodies may have some."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _task(seen: Survey) -> list[str]:
    second, guess = seen.log.a is not None, seen.goal
    gain = 1.0 if guess is None else guess.gain
    why = "not known from the log" if guess is None else "guessed from the second half"
    unit = "1/s2" if second else "1/s"
    rule = "uhat = gain (theta - x)" + (" - damping v" if second else "")
    lines = [
        line("task:", "what a robot wants; theta is what it tells nobody"),
        line("  kind: goal", "EDIT: or velocity, formation, orbit, patrol, goal_unknown_gain"),
        line(f"  gain: {short(gain)}", f"EDIT: [{unit}] {rule}; {why}"),
    ]
    if not seen.is_restless:
        lines.append(line(f"  # gain: [{short(gain / 3)}, {short(gain * 3)}]", "or bounds, with a number for noise"))
    if second:
        damping = 2 * math.sqrt(gain) if guess is None or guess.damping is None else guess.damping
        lines.append(line(f"  damping: {short(damping)}", f"EDIT: [1/s]; {why}"))
        lines.append(line("  # velocity_loop: 1.0", "instead of damping: uhat = velocity_loop (gain (theta - x) - v)"))
        return lines
    clipped = f"saturation: {{kind: norm, limit: {short(seen.fastest or 1.0)}}}"
    if seen.limited == "disc":
        lines.append(line(f"  {clipped}", "EDIT: [m/s] uhat is clipped (so many commands are that fast); or kind: box"))
    else:
        lines.append(line(f"  # {clipped}", "[m/s] uhat is clipped to this speed; or kind: box, limit: [x, y]"))
    lines.append(line("  # dead_zone: 0.05", "[m] nearer to the goal than this the robot stops"))
    return lines


def _prior(seen: Survey) -> list[str]:
    low, high = seen.extent
    size = max(float((high - low).max()), LEAST)
    lower, upper = (", ".join(coordinates(corner, size)) for corner in (low - AROUND * size, high + AROUND * size))
    return [
        line("prior:", "a box that surely holds every theta; too small a one loses goals"),
        line(f"  lower: [{lower}]", "EDIT: [m] where bodies were, and half of that around"),
        f"  upper: [{upper}]",
    ]


def _motion(found: Recognised, seen: Survey) -> list[str]:
    log = seen.log
    if log.a is not None:
        return [
            line("dynamics: double_integrator", "ax, ay are the commands; or single_integrator: vx, vy are"),
            line("velocity: logged", "commands are those of the log; or differentiated, from velocities"),
        ]
    if seen.is_unicycle:
        heading = found.heading or "heading"
        return [
            line("velocity: differentiated", "commands are recovered from poses"),
            line("body:", "EDIT: they drive along their headings; leave this out if they need not"),
            "  kind: unicycle",
            *([line(f"  heading: {word(heading)}", "the column [rad]")] if found.heading else []),
            line("  map: si_to_uni", "EDIT: from commands to wheels; or look_ahead with distance: 0.05"),
            line("  linear_gain: 1.0", "EDIT: forward speed / share of the command along the heading"),
            line("  # angular_limit: 3.14159265", "[rad/s] turn rate where the command is across; default pi"),
            line("  # wheel_limit: 0.2", "[m/s] with wheel_base: 0.11 [m]; samples at the limit are not used"),
        ]
    if log.u is not None:
        also = [
            line("# dynamics: double_integrator", "if (vx, vy) are states: with velocity: differentiated, order: 2")
        ]
        return [line("velocity: logged", "(vx, vy) at t is the command; or differentiated, or windows"), *also]
    if seen.is_restless:
        return [
            line("velocity: windows", "positions only, and measured: means over windows of time"),
            line("# windows: [0.1, 0.25, 0.5, 1.0]", "[s] their lengths; these are the default"),
        ]
    return [line("velocity: differentiated", "positions only: differences; windows if positions are measured")]


def _noise(seen: Survey) -> list[str]:
    rounding = "rounded digits of the log are added by themselves"
    position = short(rounded_up(5 / 3 * seen.jitter)) if seen.jitter > 0 else "0.0"
    lines = [line("noise:", "the largest errors, not the typical ones")]
    if seen.log.a is not None:
        lines.append(line("  acceleration: auto", "[m/s2] of commands: found from the log; or a number"))
        lines.append(line("  # velocity: 0.01", f"[m/s] of velocities; {rounding}"))
    elif seen.is_restless and not seen.is_unicycle:
        speed = short(rounded_up(OWN_ERROR * (seen.typical or 1.0)))
        lines.append(line(f"  velocity: {speed}", "EDIT: [m/s] of the controllers alone: 1 % of the typical speed"))
        lines.append(line(f"  position: {position}", "EDIT: [m] of positions: five deviations of the jitter seen"))
        return lines
    else:
        lines.append(line("  velocity: auto", "[m/s] of commands: found from the log; or a number"))
    lines.append(line("  # position: 0.001", f"[m] of positions; {rounding}"))
    lines.append(line("  # slack: 0.05", "of rows, which decides what may be active; default: that of commands"))
    if seen.is_unicycle:
        lines.append(line("  # heading: 0.005", "[rad] of headings"))
    elif seen.log.a is None:
        lines.append(line("  # neighbour_velocity: 0.01", "[m/s] of velocities that rows use of other bodies"))
    return lines


def _bodies(seen: Survey) -> list[str]:
    _, still = seen.names
    listed = f"[{', '.join(map(word, still))}]"
    told = "never moved: avoided, not inferred" if still else "bodies that are avoided but not inferred"
    return [line(f"obstacles: {listed}", told)]


def _where(found: Recognised, seen: Survey) -> list[str]:
    bodies = [word(body) for body in seen.log.bodies]
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
            line("bag:", "where the bodies are"),
            *section(found.bag, explained),
            line(rate, "[Hz] a common clock, if stamps differ; default: stamps of the first body"),
            line("  # covariance_multiple: 3", "deviations of Odometry's covariances that bound errors; default: none"),
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
        lines = [line("log:", "the form of the log"), *section(found.form, explained)]
        if found.form["format"] != "columns":
            lines.append(line('  # bodies: {r1: "Rigid Body 1"}', "takes some and names them; default: all"))
        if "unit" not in found.form:
            told = found.form["format"] in ("optitrack", "vicon")
            why = "of lengths, if the file does not say it: m, cm, mm" if told else "EDIT: of lengths: m, cm, mm"
            lines.append(line(f"  {'# ' if told else ''}unit: m", why))
        return [*lines, line("  # up: y", "axis that points up; default: y for optitrack, otherwise z"), radius]
    return []


def _rest() -> list[str]:
    return [
        "# Everything below is a default",
        line("set: inverse_optimal", "sound under errors; or critical_region, the paper's, for exact data"),
        line("# active_tolerance: 0.001", "[m/s] of critical_region: nearer to a row than this it is active"),
        line("on_inconsistent: hold", "or reset (robots that change their goals), or raise"),
        line("outliers: 0", "samples per robot that may be left unexplained"),
        line("# ukf: false", "leave the Kalman filter and the hybrid out: faster"),
        line(
            "# truth: {robot: [0.0, 0.0]}",
            "theta, where you know it: marked in tables and figures, used for nothing else",
        ),
    ]
