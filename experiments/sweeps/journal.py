"""What has been finished, on disk: one line of JSON per run, appended and synced as runs finish, in whatever order.

A process that is killed leaves at worst a last line without its end; it is cut off when the journal is opened again.
Any other line that is not JSON (a damaged disk) is passed over. Either way its run is run again, and no whole line is
ever touched.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from torchfsid.commands.results_folder import named


class Journal:
    """Use it as a context manager.

    Attributes:
        records: the whole lines, by run.
    """

    def __init__(self, path: Path):
        self.path = path
        self.records: dict[int, dict[str, Any]] = {}

    def __enter__(self) -> Journal:
        self._file = self.path.open("a+b")
        self._file.seek(0)
        *lines, rest = self._file.read().split(b"\n")
        self._file.truncate(self._file.tell() - len(rest))
        records = filter(None, map(_parse, lines))
        self.records = {record["run"]: record for record in records}
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()

    def append(self, record: dict[str, Any]) -> None:
        """Once this returns, the record survives a crash."""
        with named(self.path):
            self._file.write(json.dumps(record, allow_nan=False).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        self.records[record["run"]] = record


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) and isinstance(record.get("run"), int) else None
