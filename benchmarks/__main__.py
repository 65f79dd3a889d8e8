"""python -m benchmarks NAME [options]

NAME: geometry, polyhedra, layers, fleet, observer, gradients, safety, orca, threads, observe or
cuda.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module

NAMES = (
    "geometry",
    "polyhedra",
    "layers",
    "fleet",
    "observer",
    "gradients",
    "safety",
    "orca",
    "threads",
    "observe",
    "cuda",
)


def main(arguments: list[str]) -> int:
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help"):
        print(__doc__)
        return 0
    if name not in NAMES:
        print(f"benchmarks: expected one of {', '.join(NAMES)}, got {name!r}", file=sys.stderr)
        return 2
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: small tensors are slower with two threads
    import_module(f"benchmarks.{name}").main(rest)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
