"""`torchfsid init`: a commented configuration for a log, with what the log says of itself filled in."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from torchfsid.commands.starting_config import starting_config
from torchfsid.commands.survey import survey
from torchfsid.commands.terminal import console
from torchfsid.errors import ConfigError
from torchfsid.logs.motion import HeightError
from torchfsid.logs.read import read_log
from torchfsid.logs.recognise import recognise


def write_config(path: Path, out: Path) -> None:
    """Write a commented configuration for the log at `path`, and say what was found.

    Raises:
        LogError: the log cannot be read, or nothing in it looks like positions of bodies.
        ConfigError: there is a file `out`.
        OSError: it cannot be written.
    """
    if out.exists():
        raise ConfigError(f"--out: {out} is there, and is not replaced; choose another name")
    found = recognise(path)
    bag, form = found.sections()
    heading = found.heading or ("heading" if found.has_poses else None)
    try:
        log = read_log(path, bag, heading, form)
    except HeightError:
        log = read_log(path, bag, form=form, in_space=True)
    seen = survey(log)
    content = starting_config(path, out, found, seen)
    with out.open("x", encoding="utf-8") as file:
        file.write(content)
    moving, still = seen.names
    rest = f", {len(still)} that {'stands' if len(still) == 1 else 'stand'} still" if still else ""
    shown = partial(console().out, highlight=False)
    bodies = "1 body that moves" if len(moving) == 1 else f"{len(moving)} bodies that move"
    shown(f"{path} is {found.what}: {bodies}{rest}, {len(seen.log.t)} times.")
    shown(f"{out} is written. Edit the lines marked EDIT, then:")
    shown(f"  torchfsid check {path} --config {out}")
    shown(f"  torchfsid observe {path} --config {out} --out results")
