"""The result of `fsid.observe`: the sets of a log's robots, their course over time, and the files of the command.

The log is observed as `torchfsid observe` observes it, into a folder that lives as long as the result. `save` copies
its files.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.commands.map_panel import Marks
from torchfsid.commands.observe import Observation, Verdict
from torchfsid.commands.results_folder import OBSERVE, ResultsFolder, write_json, write_whole
from torchfsid.commands.space_figure import draw_regions
from torchfsid.config.documents import dump
from torchfsid.errors import InputError
from torchfsid.logs.log import Log
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import FeasibleSet

TEXTS = ("robot", "case", "status")
"""Columns of estimates.csv that are no numbers."""

CONFIG = "config.yaml"

MOST_SHOWN = 8
"""Robots in the text of a result."""


class Observed:
    """What a log says about its robots. `fsid.observe` makes it.

    Attributes:
        observation: the observers and the declared model, at the end of the log.
        verdicts: the final verdict on each robot: volume, diameter, centroid, status, ...
    """

    observation: Observation
    verdicts: tuple[Verdict, ...]

    def __init__(self, observation: Observation, made_from: Mapping[str, str]):
        self.observation, self._folder = observation, TemporaryDirectory(prefix="torchfsid-")
        write_whole(self._out / CONFIG, dump(observation.stated))
        observation.run(self._out, made_from=made_from)
        if observation.narrowing is not None:
            write_json(self._out / "unknown_numbers.json", observation.narrowing.to_json())
        self.verdicts = tuple(observation.verdicts())

    @property
    def _out(self) -> Path:
        return Path(self._folder.name)

    @property
    def robots(self) -> tuple[str, ...]:
        """The names of the robots, in the order of all batches."""
        return tuple(self.observation.robots)

    @property
    def log(self) -> Log:
        """The log as it was observed: with velocities from differences, if they were asked for, and without gaps."""
        return self.observation.log

    @property
    def sets(self) -> FeasibleSet:
        """The final sets, one for each robot."""
        return self.observation.sets.feasible_set

    @property
    def status(self) -> Int[Tensor, "robots"]:
        """A `Status` per robot: `OK` (no contradiction seen, no proof of the model), `ALARM` or `INCONSISTENT`."""
        return self.observation.sets.status

    @property
    def status_names(self) -> list[str]:
        """The statuses in words, one per robot."""
        return Status.names(self.status)

    @property
    def t(self) -> Float[Tensor, "times"]:
        """The times of the samples [s]."""
        return torch.from_numpy(self.log.t)

    @cached_property
    def estimates(self) -> Mapping[str, np.ndarray]:
        """The columns of estimates.csv by name: one entry per robot and time, NaN where a cell is empty.

        They make a data frame as they are: `pandas.DataFrame(result.estimates)`.
        """
        with (self._out / "estimates.csv").open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        cells = zip(*rows, strict=True) if rows else [()] * len(header)
        return MappingProxyType(
            {
                name: np.array(column) if name in TEXTS else np.array([float(cell or "nan") for cell in column])
                for name, column in zip(header, cells, strict=True)
            }
        )

    def over_time(self, name: str) -> Tensor:
        """A column of estimates.csv as a tensor (times, robots), or a vector as (times, robots, p).

        Args:
            name: `volume`, `diameter`, `radius`, `status`, ..., or a vector: `centroid`, `centre`, `ukf`, `hybrid`.

        Raises:
            InputError: there is no such column, or it is a text.
        """
        if name == "status":
            codes = [Status[word.upper()] for word in self.estimates["status"]]
            return torch.tensor(codes, dtype=torch.long).reshape(-1, len(self.robots))
        parts = [column for column in self.estimates if column.rpartition("_")[0] == name and column[-1].isdigit()]
        if name in TEXTS or (name not in self.estimates and not parts):
            known = dict.fromkeys(column.rstrip("_0123456789") for column in self.estimates if column not in TEXTS)
            raise InputError("name", f"one of {', '.join(known)}, status", repr(name))
        shape = (-1, len(self.robots))
        if name in self.estimates:
            return torch.from_numpy(self.estimates[name]).reshape(shape)
        return torch.stack([torch.from_numpy(self.estimates[part]).reshape(shape) for part in parts], dim=-1)

    def plot(self, path: str | Path | None = None) -> Path:
        """Draw the sets over the paths, their sizes and the cases over time.

        Args:
            path: a file *.png or *.pdf. None: a PNG that lives as long as this result, to be shown in a notebook by
                `IPython.display.Image(result.plot())`.

        Raises:
            InputError: the suffix is another one.
            FigureError: it cannot be drawn.
            OSError: the file cannot be written.
        """
        drawn = draw_regions(self._out, self.log.x, self.log.seen, self.log.bodies, Marks.of(self.observation.config))
        of_suffix = {figure.suffix: figure for figure in drawn}
        if path is None:
            return of_suffix[".png"]
        if Path(path).suffix not in of_suffix:
            raise InputError("path", "a file *.png or *.pdf", str(path))
        return Path(shutil.copyfile(of_suffix[Path(path).suffix], path))

    def report(self, path: str | Path = "report.html") -> Path:
        """Write the run as one HTML page that opens offline, see `torchfsid report`.

        Raises:
            OSError: the file cannot be written.
        """
        from torchfsid.commands.page.report import write_pages
        from torchfsid.commands.page.write import PAGE

        write_pages(self._out)
        return Path(shutil.copyfile(self._out / PAGE, path))

    def save(self, folder: str | Path) -> Path:
        """Write the files of `torchfsid observe` into a folder, which is made, or holds such results already.

        Raises:
            ConfigError: the folder holds something else.
            FigureError: the figure cannot be drawn.
            OSError: a file cannot be written.
        """
        self.plot()
        files = sorted(path.name for path in self._out.iterdir() if path.name != CONFIG)
        results = ResultsFolder(Path(folder), OBSERVE)
        try:
            results.claim(files, dump(self.observation.stated))
            for name in files:
                shutil.copyfile(self._out / name, results.path / name)
        finally:
            results.release()
        return results.path

    def __repr__(self) -> str:
        is_found = self.observation.smallest_bounds is not None
        robots = [
            f"{of.robot}: {self.observation.bound.cell(of.status, is_found)}, diameter {of.diameter:.3g}"
            for of in self.verdicts[:MOST_SHOWN]
        ]
        more = f", and {len(self.verdicts) - MOST_SHOWN} more" if len(self.verdicts) > MOST_SHOWN else ""
        return f"Observed({self.observation.samples} samples; {'; '.join(robots)}{more})"
