"""What has been finished, on disk: one line of JSON per run, appended and synced as runs finish, in whatever order.

A process that is killed leaves at worst a last line without its end; it is cut off when the journal is opened again.
Any other line that is not JSON (a damaged disk) is passed over. Either way its run is run again, and no whole line is
ever touched. One process at a time holds a journal.
"""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from torchfsid.errors import ConfigError


class Journal:
    """Use it as a context manager.

    Attributes:
        records: the whole lines, by run.

    Raises:
        ConfigError: another process holds the journal.
    """

    def __init__(self, path: Path):
        self.path = path
        self.records: dict[int, dict[str, Any]] = {}

    def __enter__(self) -> Journal:
        self._file = self.path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.close()
            raise ConfigError(f"{self.path.parent}: another sweep is writing there") from error
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
