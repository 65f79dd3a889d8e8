"""Benchmarks: torchfsid and its peers on the same work, in the same run. `python -m benchmarks NAME`.

Each benchmark is a module with `main(arguments)`. It prints its table and saves its results under `results/`.
"""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def save(name: str, results: Any, packages: list[str]) -> Path:
    """Save `results` (anything JSON holds) with the versions of the packages, in results/NAME.json."""
    path = RESULTS / f"{name}.json"
    versions = {"python": platform.python_version(), **{package: version(package) for package in sorted(packages)}}
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"versions": versions, "results": results}, indent=1) + "\n", encoding="utf-8")
    return path


def load(name: str) -> dict[str, Any]:
    """What `save` wrote: `versions` and `results`."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
