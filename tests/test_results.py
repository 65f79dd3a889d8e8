"""Results folders: what stands in them, one owner, no mixtures, and one line for whatever is missing or damaged."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from experiments.__main__ import main
from experiments.kinds import KINDS
from experiments.results import FIGURES, FILES
from experiments.tables import table
from torchfsid.commands.results_folder import MANIFEST, ResultsFolder
from torchfsid.commands.table_file import line_of

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "configs"
SHORT = {
    "scene": ("run", "two_pairs", "duration=0.2", "snapshots=[0.1]", "expected=[]"),
    "cases": ("run", "five_cases", "duration=0.1"),
    "swarm": ("run", "swarm", "robots=20", "side=7.5", "duration=0.06", "snapshots=[0.03]"),
}

SIZES = ("diameter", "centre_0", "centre_1", "radius", "centroid_0", "centroid_1")

pytestmark = pytest.mark.usefixtures("unchecked")


def command(kind: str, out: Path, *more: str) -> list[str]:
    name, config, *overrides = SHORT[kind]
    changes = [word for override in (*overrides, *more) for word in ("--set", override)]
    return [name, str(CONFIGS / f"{config}.yaml"), "--out", str(out), *changes]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    folders: dict[str, Path] = {}

    def run(kind: str) -> Path:
        if kind not in folders:
            folders[kind] = tmp_path_factory.mktemp(kind)
            assert main(command(kind, folders[kind])) == 0
        return folders[kind]

    return run


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# What stands in them ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SHORT)
def test_a_run_leaves_what_the_table_says(kind: str, finished: Callable[[str], Path]):
    left = {path.name for path in finished(kind).iterdir()} - {MANIFEST}
    assert left - set(FIGURES) == {file.name for file in FILES[kind]}
    assert left & set(FIGURES)


def test_every_kind_has_its_files_and_functions():
    assert KINDS.keys() == FILES.keys()
    for name, kind in KINDS.items():
        assert kind.config.model_fields["kind"].annotation is not None
        for later in (kind.run, kind.show, kind.draw):
            module = ROOT / "experiments" / (later.module.replace(".", "/") + ".py")
            assert f"def {later.name}(" in module.read_text(encoding="utf-8"), name


@pytest.mark.parametrize("kind", FILES)
def test_files_are_written_and_read_where_the_table_says(kind: str):
    """The tables of an observation are written by the package, those of a sweep by a loop over their stems."""
    for file in FILES[kind]:
        for module in filter(None, (file.writer, file.reader)):
            source = (ROOT / "experiments" / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8")
            stem = file.name.split(".")[0]
            by_package = {
                "estimates": "ResultsWriter",
                "regions": "ResultsWriter",
                "sets": "ResultsWriter",
                "config": "claim",
            }
            assert stem in source or by_package.get(stem, stem) in source, (file.name, module)


# One owner, no mixtures ---------------------------------------------------------------------------------------------


def test_a_fresh_run_that_is_interrupted_leaves_nothing_of_an_older_one(
    finished: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    shutil.copytree(finished("scene"), out)
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    program = [sys.executable, "-m", "experiments", *command("scene", out, "duration=20", "seed=3")]
    running = subprocess.Popen(program, cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    (out / "estimates.csv").unlink()
    while not ((out / "estimates.csv").exists() and (out / "estimates.csv").stat().st_size > 3000):
        assert running.poll() is None
        time.sleep(0.02)
    assert main(command("scene", out)) == 2
    assert main(["figures", str(out)]) == 2
    assert capsys.readouterr().err.count("another command is writing there") == 2
    running.send_signal(signal.SIGTERM)
    _, errors = running.communicate(timeout=60)
    assert running.returncode == 128 + signal.SIGTERM
    assert errors.splitlines()[-1] == f"experiments: stopped by SIGTERM; what is done so far is in {out}"
    left = content(out)
    assert "seed: 3" in left["config.yaml"].decode()
    assert left.keys() - {MANIFEST} == {
        "config.yaml",
        "trajectory.csv",
        "estimates.csv",
        "regions.json",
        "regions.jsonl",
        "sets.csv",
        "notes.txt",
    }
    assert left["estimates.csv"].endswith(b"\n")
    assert main(["figures", str(out)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f"{out / 'estimates.csv'}: has " in message
    assert content(out).keys() == left.keys()


def test_a_folder_of_another_kind_is_left_alone(finished: Callable[[str], Path], capsys: pytest.CaptureFixture[str]):
    before = content(finished("scene"))
    assert main(command("cases", finished("scene"))) == 2
    assert "holds the results of 'scene'" in capsys.readouterr().err
    assert content(finished("scene")) == before


def test_a_full_disk_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    def full(self: Path, *_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    assert main(command("scene", tmp_path / "out")) == 1
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == f"experiments: {tmp_path / 'out' / 'figure.png'}: No space left on device"
    assert "UKF error" in captured.out
    assert (tmp_path / "out" / "summary.json").exists()


def test_what_does_not_fit_on_the_disk_is_not_cut_in_two(tmp_path: Path):
    """Files of at most 32 kB: the run ends with the name of the file, and every line that is there is whole."""
    out = tmp_path / "out"
    limited = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (32768, 32768)); "
    program = limited + "from experiments.__main__ import main; sys.exit(main(sys.argv[1:]))"
    ran = subprocess.run(
        [sys.executable, "-c", program, *command("scene", out, "duration=1")], cwd=ROOT, capture_output=True, text=True
    )
    assert ran.returncode == 1
    assert ran.stderr.splitlines()[-1] == f"experiments: {out / 'regions.jsonl'}: File too large"
    for name in ("regions.jsonl", "estimates.csv", "trajectory.csv"):
        assert (out / name).read_bytes().endswith(b"\n")
    assert (out / "regions.json").exists()


# Missing and damaged ------------------------------------------------------------------------------------------------


def without_column(text: str, at: int) -> str:
    return "".join(",".join(c for i, c in enumerate(line.split(",")) if i != at) + "\n" for line in text.splitlines())


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda whole: b"",
    "cut off": lambda whole: whole[: len(whole) // 2],
    "no text": lambda whole: bytes(range(256)),
    "last line lost": lambda whole: b"".join(whole.splitlines(keepends=True)[:-1]),
}


@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, file.name) for kind in SHORT for file in FILES[kind] if file.reader and file.name != "config.yaml"],
)
def test_a_damaged_file_is_named(
    kind: str, name: str, finished: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    shutil.copytree(finished(kind), out)
    whole = (out / name).read_bytes()
    capsys.readouterr()  # what the run printed
    for what, damage in DAMAGES.items():
        (out / name).write_bytes(damage(whole))
        assert_names(out / name, what, capsys)
    if name.endswith(".json"):
        for key in ("cases", "truth_outside"):
            (out / name).write_text(json.dumps({**json.loads(whole), key: None}), encoding="utf-8")
            if key in json.loads(whole):
                assert_names(out / name, f"{key} is null", capsys)
    if name.endswith(".csv"):
        wanted = {"estimates.csv": 4, "trajectory.csv": 2, "sizes.csv": 2, "snapshots.csv": 6}[name]
        (out / name).write_text(without_column(whole.decode(), wanted), encoding="utf-8")
        assert_names(out / name, "column lost", capsys)
        header, first, *rows = whole.decode().splitlines(keepends=True)
        cells = first.split(",")
        (out / name).write_text("".join([header, ",".join([*cells[:wanted], "x", *cells[wanted + 1 :]]), *rows]))
        assert_names(out / name, "no number", capsys)
    (out / name).unlink()
    assert_names(out / name, "missing", capsys)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["scene", "cases"])
def test_an_empty_set_is_drawn_as_nothing(kind: str, finished: Callable[[str], Path], tmp_path: Path):
    """It has no vertices, and where it has no size its cells are empty."""
    out = tmp_path / "out"
    shutil.copytree(finished(kind), out)
    lines = [json.loads(line) for line in (out / "regions.jsonl").read_text(encoding="utf-8").splitlines()]
    emptied = [json.dumps({**line, "critical_region": [], "inverse_optimal": []}) + "\n" for line in lines]
    (out / "regions.jsonl").write_text("".join(emptied), encoding="utf-8")
    with (out / "estimates.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    sizes = [name for name in rows[0] if name.endswith(SIZES)]
    with (out / "estimates.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({**row, **dict.fromkeys(sizes, "")} for row in rows)
    assert main(["figures", str(out)]) == 0


def assert_names(path: Path, what: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figures", str(path.parent)]) == 2, what
    message = capsys.readouterr().err.replace("Drawing\n", "")
    assert message.count("\n") == 1, what
    assert message.startswith(f"experiments: {path}: "), (what, message)


def test_a_folder_that_holds_no_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["figures", str(tmp_path / "nowhere")]) == 2
    (tmp_path / "config.yaml").write_text("title: mine\n", encoding="utf-8")
    assert main(["figures", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 2
    assert os.listdir(tmp_path) == ["config.yaml"]
    ResultsFolder(tmp_path / "nowhere", None).require_ours()


# For people ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [60, 80, 100])
def test_tables_are_wrapped_and_never_cut(width: int):
    numbers = "runs", "robots", "paper's lost", "silently", "√area", "inv.-opt. lost", "√area", "UKF", "hybrid"
    shown = table(["velocity, position", "shape", "neighbour velocity"], numbers)
    shown.add_row("1e-06 m/s, 1 µm", "adversarial", "current", "50", "348", "211", "17", *["0.3 mm", "0", "1.2 µm"] * 2)
    for console in (Console(file=io.StringIO(), width=width), wide := Console(file=io.StringIO(), width=400)):
        console.print(shown)
    texts = ["".join(sorted(c.file.getvalue())).strip().replace("─", "") for c in (console, wide)]  # type: ignore[attr-defined]
    assert texts[0].strip() == texts[1].strip()


@pytest.mark.parametrize("name", ["plain", "a,b", 'a"b', "two\nlines", "two\rlines", "two\r\nlines", "", "=1"])
def test_any_name_comes_back_from_a_table(name: str):
    lines = [f"{line_of([name, 'end'])}\r\n" for _ in range(2)]
    assert list(csv.reader(io.StringIO("".join(lines), newline=""))) == 2 * [[name, "end"]]
    assert list(csv.reader(lines)) == 2 * [[name, "end"]]  # a line in memory, as it is copied into MCAP
