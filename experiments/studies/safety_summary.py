"""The tables and the figure of `safety_parameters`, from the files it writes. This module does not import torch.

The figure shows what is learned of gain and safety distance: an example, the cost in Theta, enclosures by bound and by
time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.figures.style import HYBRID, INVERSE_OPTIMAL, ROBOT, STYLE
from experiments.results import Columns, read_columns, read_json

ACTIVE = 0.1
"""Rows count as active in a team where they are for at least this share of the robots' samples."""

TARGET = 1.1
"""Largest ratio of diameters that is hardly a loss."""

COLOURS = {"gain": INVERSE_OPTIMAL, "safety distance": ROBOT}
DASHES = {"1": "-", "3": (0, (3, 1.5))}
STAGES = {0: ("after 1 s", "0.8"), 1: ("after 2 s", "0.4"), -1: ("second look", INVERSE_OPTIMAL)}
"""Those that are drawn of a team's sets, their labels and colours."""

SECONDS = {"1 s": 1.0, "2 s": 2.0, "4 s": 4.0, "streamed": 8.0}
"""Places of the stages on the time axis; the last one is the end."""

FLOOR = 1e-6
"""Smaller excesses of diameters are round-off."""


def tables(folder: Path) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """The tables of the study, by title."""
    sets, robots = read_columns(folder / "sets.csv"), read_columns(folder / "robots.csv")
    yield "What is lost, by errors", list(_losses(sets, robots))
    yield "Diameters of Theta: unknown to known parameters", list(_ratios(robots))
    reached = robots.numbers("reached") / robots.numbers("looked")
    checked = {"robots": int((~np.isnan(reached)).sum()), "reached by known parameters": int((reached > 0.9).sum())}
    yield f"Ratios above {TARGET}", [checked]
    yield "Enclosures, by form", list(_enclosures(sets))
    yield "Enclosures, by bound", _told(by_bound(sets))
    yield "Enclosures, by time", _told(by_time(sets))
    yield "Enclosures, by prior", _told(_by_prior(sets))
    yield "One robot with another gain", list(_odd(sets, robots))
    yield "Seconds", [_seconds(sets, robots)]


def half_widths(sets: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Half the widths of the intervals of gain and safety distance, relative to the truth."""
    return tuple(
        (sets.numbers(f"{name}_high") - sets.numbers(f"{name}_low")) / 2 / sets.numbers(truth)
        for name, truth in (("gain", "gain"), ("distance", "safety_distance"))
    )  # type: ignore[return-value]


def with_active_rows(sets: Columns) -> Columns:
    """The teams whose rows are active."""
    of_samples = sets.numbers("robots") * sets.numbers("samples")
    return sets.rows(sets.numbers("active") >= ACTIVE * of_samples)


def _losses(sets: Columns, robots: Columns) -> Iterator[dict[str, Any]]:
    looked = sets.where(stage="looked")
    looked = looked.rows(looked["part"] != "odd")
    about = "position", "velocity", "errors"
    for values in sorted({*zip(*(looked[name] for name in about), strict=True)}):
        chosen = dict(zip(about, values, strict=True))
        of_sets, of_robots = looked.where(**chosen), robots.where(**chosen)
        of_robots = of_robots.rows(of_robots["part"] != "odd")
        counted = {
            name: int(of_sets.numbers(name).sum()) for name in ("goals_lost", "safety_lost", "flagged", "refuted")
        }
        ratio = of_robots.numbers("looked") / of_robots.numbers("known")
        yield {
            **chosen,
            "teams": len(of_sets["run"]),
            "robots": len(ratio),
            **counted,
            "infeasible": int(of_sets.numbers("infeasible").sum()),
            **_spread(ratio),
        }


def _ratios(robots: Columns) -> Iterator[dict[str, Any]]:
    robots = robots.rows(robots["part"] != "odd")
    for prior, stage in product(sorted({*robots["gain_prior"]}, key=float), ("streamed", "looked")):
        chosen = robots.where(gain_prior=prior)
        ratio = chosen.numbers(stage) / chosen.numbers("known")
        yield {"gain_prior": prior, "stage": stage, "robots": len(ratio), **_spread(ratio)}


def _spread(ratio: np.ndarray) -> dict[str, float]:
    return {
        "median": float(np.median(ratio)),
        "p99": float(np.quantile(ratio, 0.99)),
        "max": float(ratio.max()),
        f"below {TARGET}": float((ratio < TARGET).mean()),
    }


def _enclosures(sets: Columns) -> Iterator[dict[str, Any]]:
    tenths = with_active_rows(sets.where(part="settings", errors="tenth", position=0.0, stage="looked"))
    narrow, wide = tenths.where(variant=0), tenths.where(variant=1)
    assert (narrow["run"] == wide["run"]).all()
    keys = "power", "rows", "distance", "velocity"
    groups = {*zip(*(narrow[key] for key in keys), strict=True)}
    for power, velocity in product("13", sorted({*narrow["velocity"]})):
        groups.add((power, "all", "all", velocity))
    for values in sorted(groups):
        chosen = {key: value for key, value in zip(keys, values, strict=True) if value != "all"}
        found, wider = narrow.where(**chosen), wide.where(**chosen)
        ends = [f"{name}_{end}" for name in ("gain", "distance") for end in ("low", "high")]
        truths = ["gain", "gain", "safety_distance", "safety_distance"]
        moved = [
            np.abs(wider.numbers(e) - found.numbers(e)) / found.numbers(t) for e, t in zip(ends, truths, strict=True)
        ]
        same = np.max(moved, axis=0) <= 0.01
        yield (
            dict(zip(keys, values, strict=True))
            | {"teams": len(same)}
            | _widths(found)
            | {
                "wider: within 1 %": float(same.mean()),
                "wider: gain": float(np.median(half_widths(wider)[0])),
                "wider: distance": float(np.median(half_widths(wider)[1])),
            }
        )


def _widths(sets: Columns) -> dict[str, float]:
    return {
        f"{name} {label}": float(np.quantile(widths, of)) if len(widths) else np.nan
        for name, widths in zip(("gain", "distance"), half_widths(sets), strict=True)
        for label, of in (("median", 0.5), ("p90", 0.9))
    } | {f"{name} by data": float((sets[f"{name}_by_data"] == "True").mean()) for name in ("gain", "distance")}


def by_power(sets: Columns, by: str) -> Iterator[tuple[dict[str, str], Columns]]:
    """The teams whose rows are active, by power and another column."""
    sets = with_active_rows(sets)
    for power, value in product("13", dict.fromkeys(sets[by])):
        found = sets.where(power=power, **{by: value})
        if len(found["run"]):
            yield {"power": power, by: value}, found


def by_bound(sets: Columns) -> Iterator[tuple[dict[str, str], Columns]]:
    """The same teams with several bounds."""
    return by_power(sets.where(part="shrinking", stage="looked", gain_prior=100.0), "velocity")


def by_time(sets: Columns) -> Iterator[tuple[dict[str, str], Columns]]:
    """Teams with a bound of 5 mm/s at several times."""
    return by_power(sets.where(errors="tenth", position=0.0, velocity=0.005, gain_prior=100.0), "stage")


def _by_prior(sets: Columns) -> Iterator[tuple[dict[str, str], Columns]]:
    return by_power(sets.where(part="shrinking", stage="looked", velocity=0.005), "gain_prior")


def _told(groups: Iterator[tuple[dict[str, str], Columns]]) -> list[dict[str, Any]]:
    return [about | {"teams": len(found["run"])} | _widths(found) for about, found in groups]


def _odd(sets: Columns, robots: Columns) -> Iterator[dict[str, Any]]:
    of_teams, of_robots = sets.where(part="odd", stage="looked"), robots.where(part="odd")
    for rows, power in product(("none", "previous"), "13"):
        found, members = of_teams.where(rows=rows, power=power), of_robots.where(rows=rows, power=power)
        right = [
            bool((members["differs"][members["run"] == run] == members["named"][members["run"] == run]).all())
            for run in found["run"]
        ]
        yield {"rows": rows, "power": power, "teams": len(right)} | {
            "refuted": int((found.numbers("refuted") > 0).sum()),
            "named, alone": sum(right),
            **{name: int(found.numbers(name).sum()) for name in ("goals_lost", "safety_lost", "flagged")},
        }


def _seconds(sets: Columns, robots: Columns) -> dict[str, Any]:
    return {stage: float(np.median(sets.where(stage=stage).numbers("seconds"))) for stage in ("streamed", "looked")} | {
        "known": float(np.median(robots.numbers("seconds")))
    }


def as_markdown(title: str, rows: list[dict[str, Any]]) -> str:
    """A table as in docs/safety_parameters.md."""
    if not rows:
        return f"\n{title}: no teams"
    lines = [f"\n{title}\n", f"| {' | '.join(rows[0])} |", "|---" * len(rows[0]) + "|"]
    lines += [f"| {' | '.join(f'{v:.4g}' if isinstance(v, float) else str(v) for v in row.values())} |" for row in rows]
    return "\n".join(lines)


def draw_study(folder: Path) -> Figure:
    """The figure of the study, from its files."""
    sets, robots = read_columns(folder / "sets.csv"), read_columns(folder / "robots.csv")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 5.8), layout="constrained")
        (example, cost), (bounds, times) = figure.subplots(2, 2)
        _draw_example(example, _telling(read_json(folder / "shapes.json")))
        _draw_cost(cost, robots.where(gain_prior=100.0).rows(robots.where(gain_prior=100.0)["part"] != "odd"))
        _draw_widths(bounds, by_bound(sets), float)
        bounds.set(xscale="log", xlabel="declared bound of velocities [m/s]", title="c)  Enclosures by bound")
        _draw_widths(times, (group for group in by_time(sets) if group[0]["stage"] in SECONDS), SECONDS.__getitem__)
        times.set(xscale="log", xlabel="t [s]", title="d)  Enclosures by time, bound 5 mm/s")
        times.set_xticks(list(SECONDS.values()), ["1", "2", "4", "end"])
        times.minorticks_off()
        figure.legend(*bounds.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _telling(shapes: list[dict[str, Any]]) -> dict[str, Any]:
    """The team with p = 1 whose Psi shrinks most nearly to a third between the stages drawn: all can be seen."""

    def unlike(shape: dict[str, Any]) -> float:
        extents = [np.ptp(np.array(shape["sets"][place]), axis=0).prod() for place in STAGES]
        return float(np.abs(np.diff(np.log(extents)) + np.log(3.0)).sum())

    return min([shape for shape in shapes if shape["power"] == 1] or shapes, key=unlike)


def _draw_example(axes: Axes, shape: dict[str, Any]) -> None:
    for place, (stage, shade) in STAGES.items():
        corners = shape["sets"][place]
        gain, distance = np.array([*corners, corners[0]]).T
        axes.fill(gain, distance, color=shade, alpha=0.25, lw=0)
        axes.plot(gain, distance, color=shade, lw=1.4, label=stage)
    axes.plot(*shape["truth"], "+", color=ROBOT, ms=9, mew=1.5, label="truth")
    axes.set(xlabel="gain", ylabel="safety distance [m]", title=f"a)  Ψ of a team of {shape['robots']}")
    axes.margins(0.12)
    axes.legend(loc="lower right", fontsize=7)


def _draw_cost(axes: Axes, robots: Columns) -> None:
    known = robots.numbers("known")
    for name, label, colour in (("streamed", "one pass", HYBRID), ("looked", "second look", INVERSE_OPTIMAL)):
        excess = np.sort(robots.numbers(name) / known - 1)
        left = 1 - np.arange(len(excess)) / len(excess)
        axes.step(excess[excess > FLOOR], left[excess > FLOOR], color=colour, label=label, lw=1.6)
    axes.axvline(0.1, color="0.6", lw=0.8, ls=(0, (1, 1)))
    axes.set(xscale="log", yscale="log", xlim=(FLOOR, None), ylim=(0.5 / len(known), 1))
    axes.set(xlabel="diameter of Θ, unknown / known Ψ, minus 1", ylabel="share of robots above")
    axes.set_title(f"b)  Cost in Θ, {len(known)} robots")
    axes.grid(True)
    axes.legend()


def _draw_widths(axes: Axes, groups: Iterable[tuple[dict[str, str], Columns]], place: Callable[[str], float]) -> None:
    lines: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    for about, found in groups:
        power, value = about.values()
        for name, widths in zip(COLOURS, half_widths(found), strict=True):
            lines.setdefault((power, name), []).append((place(value), *np.quantile(widths, (0.25, 0.5, 0.75))))
    for (power, name), points in lines.items():
        x, low, middle, high = np.array(sorted(points)).T
        axes.fill_between(x, low, high, color=COLOURS[name], alpha=0.12, lw=0)
        axes.plot(x, middle, color=COLOURS[name], ls=DASHES[power], lw=1.6, label=f"{name}, p = {power}")
    axes.set(yscale="log", ylabel="half width / truth")
    axes.grid(True)
