"""The journal of a sweep: one line of JSON per finished run, appended and synced in the order of finishing.

A process that is killed may leave a last line without its end. It is cut off when the journal is opened again. Any
other line that is not JSON (a damaged disk) is ignored. In both cases the run is run again. Whole lines are never
changed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.results import Appender


class Journal(Appender):
    """The journal, as a context manager.

    Attributes:
        records: the records of whole lines, by number of the run.
    """

    def __init__(self, path: Path):
        super().__init__(path, keep=True)
        self.file.seek(0)
        *lines, rest = self.file.read().split(b"\n")
        self.file.truncate(self.file.tell() - len(rest))
        records = filter(None, map(_parse, lines))
        self.records: dict[int, dict[str, Any]] = {record["run"]: record for record in records}

    def add(self, records: Sequence[dict[str, Any]]) -> None:
        """Append records. After the return they survive a crash."""
        self.append("".join(json.dumps(record, allow_nan=False) + "\n" for record in records))
        os.fsync(self.file.fileno())
        self.records |= {record["run"]: record for record in records}


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) and isinstance(record.get("run"), int) else None
