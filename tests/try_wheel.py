"""Install the wheel of `dist/` into a clean environment outside the checkout, and use it as a new user would.

python tests/try_wheel.py WHEEL CONSTRAINTS         `make dist` does this
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

GOALS = {"a": (1.0, 2.0), "b": (-1.0, 0.0)}
LOG = ["t,robot,x,y,vx,vy"]
for k in range(40):
    for robot, (goal, y) in GOALS.items():
        x = goal - 2 * goal * 0.95**k  # from -goal, with the command 0.5 (goal - x), held for 0.1 s
        LOG.append(f"{k / 10},{robot},{x!r},{y},{0.5 * (goal - x)!r},0.0")


def main(wheel: Path, constraints: Path) -> None:
    """Install, import, and run each command. Raises CalledProcessError or AssertionError if something is wrong."""
    with tempfile.TemporaryDirectory(prefix="torchfsid-") as name:
        folder = Path(name)
        subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
        here = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        bin_folder = folder / "venv" / "bin"

        def run(*command: str) -> str:
            print("$", *command, flush=True)
            return subprocess.run(
                [bin_folder / command[0], *command[1:]],
                cwd=folder,
                env=here,
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            ).stdout

        run("pip", "install", "--quiet", "--disable-pip-version-check", "-c", str(constraints), f"{wheel}[ros]")
        version = wheel.name.split("-")[1]
        where = run("python", "-c", "import torchfsid; print(torchfsid.__file__); torchfsid.SetMembershipObserver")
        assert where.startswith(str(folder)), where
        for command in (["torchfsid", "--version"], ["python", "-m", "torchfsid", "--version"]):
            assert run(*command) == f"torchfsid {version}\n", version
        (folder / "run.csv").write_text("\n".join(LOG))
        run("torchfsid", "schema")
        run("torchfsid", "init", "run.csv")
        run("torchfsid", "check", "run.csv", "--config", "config.yaml")
        print(
            run("torchfsid", "observe", "run.csv", "--config", "config.yaml", "--out", "results", "--mcap", "run.mcap")
        )
        for file in ("results/estimates.csv", "results/regions.json", "results/regions.png", "run.mcap"):
            assert (folder / file).stat().st_size > 0, file
        regions = json.loads((folder / "results" / "regions.json").read_text())["robots"]
        for robot, goal in GOALS.items():
            assert math.dist(regions[robot]["centroid"], goal) < 1e-3, regions[robot]["centroid"]
    print(f"{wheel.name}: installed and tried outside the checkout")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
