"""What results are made from: the version of the package, and the log, by its path and a digest of its content."""

from __future__ import annotations

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from torchfsid.logs.log import Log


def made_from(log: Path | Log) -> dict[str, str]:
    """The entry `made_from` of regions.json. A log in memory may have been changed since it was read: it has no digest.

    Raises:
        OSError: the log cannot be read.
    """
    if isinstance(log, Path):
        return {"torchfsid": _version(), "log": str(log), "sha256": _digest(log)}
    return {"torchfsid": _version(), "log": log.source}


def _digest(log: Path) -> str:
    """The digest of a file, or of a bag: that of its files, in the order of their names."""
    digest = hashlib.sha256()
    for file in sorted(path for path in log.rglob("*") if path.is_file()) if log.is_dir() else [log]:
        with file.open("rb") as content:
            while block := content.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _version() -> str:
    try:
        return version("torchfsid")
    except PackageNotFoundError:  # from a checkout that is not installed
        return "unknown"
