"""What the page shows, read from a results folder into one record of plain values (`content`).

Times are seconds of the log, or since its first sample where the log counts from 1970. Whatever was left out, because
a page must stay small or because a file is missing, is a sentence in `notes`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.page import words
from torchfsid.commands.page.motion import read_motion
from torchfsid.commands.page.sets import Facets, drawn, fewer, read_sets
from torchfsid.commands.page.tables import Table, rounded, significant, thinned
from torchfsid.config.documents import read_yaml
from torchfsid.errors import ConfigError, FigureError, one_line

MOST_TIMES = 2000
"""Times of estimates.csv on the page."""

MOST_LINES = 30_000
"""Lines of estimates.csv on the page: a time has one for each robot."""

EPOCH = 1e8
"""Times beyond this one [s] are stamps of a clock: the page counts from the first."""

PLACES = {"goal": "goal", "orbit": "centre of the orbit"}
"""Tasks whose parameter is a place on the map, and what it is."""

PARAMETERS = {
    "goal_unknown_gain": (["k", "k x", "k y"], ["1/s", "m/s", "m/s"]),
    "velocity": (["v x", "v y"], ["m/s", "m/s"]),
    "formation": (["offset x", "offset y"], ["m", "m"]),
}
"""Names and units of the parameters of the other tasks."""

DRAWN = (2, 3)
"""Numbers of parameters whose sets are drawn."""


Told = Mapping[str, Sequence[Sequence[str]]]
"""Further lines on robots, each a name and a value."""


def content(
    folder: Path, truth: Mapping[str, Sequence[float]] | None = None, told: Told | None = None
) -> dict[str, Any]:
    """Everything that the page of a results folder shows.

    Args:
        folder: the results folder of `torchfsid observe` or of an experiment with a scene.
        truth: the true parameter of each robot, where it is known and not in config.yaml.
        told: further lines on some robots.

    Raises:
        FigureError: estimates.csv or regions.json is missing, or a file is damaged.
    """
    notes: list[str] = []
    config, final = _config(folder, notes), _json(folder / "regions.json")
    try:
        found = _content(folder, config, final, truth or config.get("truth") or {}, notes)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise FigureError(f"{folder}: its files are damaged: {type(error).__name__}: {one_line(error)}") from error
    for robot in found["robots"]:
        robot["told"] = (told or {}).get(robot["name"], [])
    return found


def _content(
    folder: Path, config: Mapping[str, Any], final: Mapping[str, Any], truth: Mapping[str, Any], notes: list[str]
) -> dict[str, Any]:
    history = Estimates(Table(folder / "estimates.csv"))
    start = float(history.t[0])
    if start > EPOCH:
        notes.append(f"Times count from the first sample, at {start:.15g} s.")
    else:
        start = 0.0

    def shift(t: float | None) -> float | None:
        return None if t is None or not math.isfinite(t) else round(t - start, 6)

    def clock(t: float) -> str:
        return f"{t - start:.6g} s"

    kept = history.kept(notes)
    names: dict[str, int] = {}
    motion = read_motion(folder, names, shift, notes)
    n = len(motion["axes"]) if motion else 2
    kind = (config.get("task") or {}).get("kind")
    is_place = history.dim == n and kind in (*PLACES, None)
    parameters, units = PARAMETERS.get(str(kind), ([f"θ{i}" for i in range(history.dim)], [""] * history.dim))
    if is_place:
        parameters, units = list("xyz"[:n]), ["m"] * n
    if len(parameters) != history.dim:
        parameters, units = [f"θ{i}" for i in range(history.dim)], [""] * history.dim
    sets, around = _sets(folder, final, history, notes), history.around()
    bound = JudgedBound.from_json(final["bound"]) if "share" in (final.get("bound") or {}) else None
    robots = []
    for i, robot in enumerate(history.robots):
        region = final["robots"][robot]
        robots.append(
            {
                "name": robot,
                "status": region["status"],
                "meaning": words.meaning(region["status"], bound),
                "evidence": words.evidence(region, shift),
                "skipped": region.get("skipped"),
                "last_cut": shift(region.get("last_cut")),
                "truth": list(truth[robot]) if robot in truth else region.get("truth", {}).get("theta"),
                "inside": region.get("truth", {}).get("inside"),
                "sets": drawn(sets.get(robot, []), around, names),
                **history.of_robot(i, kept, shift),
            }
        )
        for one in robots[-1]["sets"]:
            one[0] = shift(one[0])
            for facet in one[3]:
                facet[1] = shift(facet[1])
    prior = config.get("prior") or {}
    return {
        "title": folder.resolve().name,
        "heading": config.get("title"),
        "samples": len(history.t),
        "t": [shift(t) for t in history.t[kept].tolist()],
        "dim": history.dim,
        "is_place": is_place,
        "place": PLACES.get(str(kind), "parameter"),
        "parameters": parameters,
        "units": units,
        "robots": robots,
        "names": list(names),
        "motion": motion,
        "prior": [prior["lower"], prior["upper"]] if "lower" in prior and "upper" in prior else None,
        "keep_out": _keep_out(config),
        "model": [*words.model(config), *words.of_bound(bound)],
        "useless": bound is not None and bound.is_useless,
        "safety": _safety(final),
        "refutations": [words.of_refutation(found, clock) for found in final.get("refutations", [])],
        "odd": final.get("odd", []),
        "config": _text(folder / "config.yaml"),
        "notes": notes,
    }


class Estimates:
    """estimates.csv by time and robot.

    Attributes:
        robots: names of the robots.
        t: times (T,) [s].
        dim: the number of parameters.
    """

    def __init__(self, table: Table):
        self._table, self._read = table, dict[str, np.ndarray]()
        self.robots = list(dict.fromkeys(table.texts("robot")))
        if not self.robots or table.rows % len(self.robots):
            raise FigureError(f"{table.path}: is damaged: the robots have not the same times, or none")
        self.t = self._by_robot("t")[:, 0]
        self.dim = len(table.indexed("centroid"))
        self._case = np.array(table.texts("case")).reshape(-1, len(self.robots))
        self._status = np.array(table.texts("status")).reshape(-1, len(self.robots))

    def kept(self, notes: list[str]) -> np.ndarray:
        """Indices of the times on the page: evenly, and whenever the status of a robot changes."""
        changes = np.flatnonzero((self._status[1:] != self._status[:-1]).any(-1)) + 1
        kept = thinned(len(self.t), min(MOST_TIMES, MOST_LINES // len(self.robots)), changes.tolist())
        if len(kept) < len(self.t):
            notes.append(f"{len(kept)} of the {len(self.t)} times in estimates.csv are shown, evenly chosen.")
        return kept

    def around(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of a box that holds every set: none is further from its centroid than its diameter."""
        centroid = self._table.numbers(*self._table.indexed("centroid"))
        reach = 1.1 * self._table.numbers("diameter") + 1e-9 * (1 + np.abs(centroid))
        there = np.isfinite(centroid).all(-1)
        if not there.any():
            return np.zeros(self.dim), np.ones(self.dim)
        return (centroid - reach)[there].min(0), (centroid + reach)[there].max(0)

    def of_robot(self, i: int, kept: np.ndarray, shift: words.Shift) -> dict[str, Any]:
        """The columns of a robot at the kept times."""
        diameter = self._by_robot("diameter")[kept, i]
        found: dict[str, Any] = {
            "diameter": significant(diameter),
            "volume": significant(self._by_robot("volume")[kept, i]),
            "case": "".join(case or " " for case in self._case[kept, i]),
            "statuses": self._statuses(i, shift),
        }
        finest = float(np.nanmin(diameter, initial=math.inf, where=diameter > 0))
        resolution = 1e-3 * finest if math.isfinite(finest) else 1e-9
        for name in ("centroid", "ukf", "hybrid"):
            columns = self._table.indexed(name)
            values = np.stack([self._by_robot(column)[kept, i] for column in columns], axis=-1) if columns else None
            found[name] = None if values is None or np.isnan(values).all() else rounded(values, resolution)
        return found

    def _statuses(self, i: int, shift: words.Shift) -> list[list[Any]]:
        """Times from which a robot has a status."""
        status = self._status[:, i]
        starts = np.concatenate([[0], np.flatnonzero(status[1:] != status[:-1]) + 1])
        return [[shift(float(self.t[k])), str(status[k])] for k in starts]

    def _by_robot(self, column: str) -> np.ndarray:
        if column not in self._read:
            self._read[column] = self._table.numbers(column).reshape(-1, len(self.robots))
        return self._read[column]


def _sets(folder: Path, final: Mapping[str, Any], history: Estimates, notes: list[str]) -> dict[str, list[Facets]]:
    """The sets to be drawn. Without sets.csv these are the final ones."""
    if history.dim not in DRAWN:
        notes.append(f"Sets of {history.dim} parameters are not drawn; their sizes are.")
        return {}
    if (folder / "sets.csv").is_file():
        from torchfsid.commands.history import STEP

        notes.append(
            f"sets.csv has a set again when it has changed by {STEP:.0%}. "
            "In between the older one is drawn, which contains the newer."
        )
        return fewer(read_sets(folder / "sets.csv"), notes)
    notes.append("sets.csv is missing: only the final sets are drawn, at the end (torchfsid observe writes it).")
    end = float(history.t[-1])
    return {
        robot: [
            Facets(
                end,
                np.array(region["A"], dtype=float).reshape(-1, history.dim),
                np.array(region["b"], dtype=float),
                [words.row_name(facet) for facet in region["facets"]],
                np.array([math.nan if facet["time"] is None else facet["time"] for facet in region["facets"]]),
            )
        ]
        for robot, region in final["robots"].items()
    }


def _keep_out(config: Mapping[str, Any]) -> float | None:
    """The declared safety distance [m], if one number holds for all bodies."""
    for barrier in config.get("barriers") or []:
        distance = barrier.get("safety_distance") if isinstance(barrier, Mapping) else None
        if isinstance(distance, int | float):
            return float(distance)
    return None


def _safety(final: Mapping[str, Any]) -> list[dict[str, Any]]:
    if "safety" in final:
        return [words.of_safety("the team", final["safety"])]
    of_robots = final["robots"].items()
    return [words.of_safety(robot, region["safety"]) for robot, region in of_robots if "safety" in region]


def _config(folder: Path, notes: list[str]) -> dict[str, Any]:
    if not (folder / "config.yaml").is_file():
        notes.append("config.yaml is missing: the parameters are taken for places, and the prior is not drawn.")
        return {}
    try:
        return read_yaml(folder / "config.yaml")
    except ConfigError as error:
        raise FigureError(str(error)) from error


def _json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        assert isinstance(found, dict)
        return found
    except (OSError, ValueError, AssertionError) as error:
        raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error


def _text(path: Path) -> str | None:
    return path.read_text(encoding="utf-8") if path.is_file() else None
