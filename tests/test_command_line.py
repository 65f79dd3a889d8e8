"""The scaffold of all commands: exit codes, one line on stderr, signals, and output that nobody reads."""

import errno
import io
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from rich.console import Console
from rich.markup import escape

import experiments.__main__
import torchfsid.cli
from torchfsid.commands.clock import seconds
from torchfsid.commands.command_line import execute
from torchfsid.commands.interruption import uninterrupted
from torchfsid.commands.results_folder import ResultsFolder
from torchfsid.commands.terminal import aside, console, digits, status, table, track
from torchfsid.errors import ConfigError, LogError


def fail(error: BaseException) -> Callable[[], None]:
    def action() -> None:
        raise error

    return action


def answer(capsys: pytest.CaptureFixture[str], action: Callable[[], object], folder: ResultsFolder | None) -> tuple:
    code = execute("prog", action, folder)
    errors = capsys.readouterr().err
    assert errors.count("\n") <= 1
    return code, errors.removesuffix("\n")


@pytest.mark.parametrize(
    ("error", "before", "after", "line"),
    [
        (ConfigError("a: wrong"), 2, 1, "prog: a: wrong"),
        (LogError("empty"), 2, 1, "prog: empty"),
        (OSError(errno.EACCES, "Permission denied", "x.csv"), 2, 1, "prog: x.csv: Permission denied"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, 1, "prog: standard output: No space left on device"),
        (MemoryError(), 1, 1, "prog: not enough memory"),
        (KeyboardInterrupt(), 130, 130, "prog: interrupted"),
    ],
)
def test_mistakes_and_failures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], error: BaseException, before: int, after: int, line: str
) -> None:
    """A mistake is one as long as nothing is written; what is done is only spoken of where something can be."""
    out = tmp_path / "out"
    assert answer(capsys, fail(error), None) == (before, line)
    assert answer(capsys, fail(error), ResultsFolder(out, "observe")) == (before, line)
    assert not out.exists()
    folder = ResultsFolder(out, "observe")

    def later() -> None:
        folder.claim([])
        raise error

    done = f"; what is done so far is in {out}" if isinstance(error, KeyboardInterrupt) else ""
    assert answer(capsys, later, folder) == (after, line + done)
    assert not folder.claimed


def test_what_nobody_foresaw_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        execute("prog", lambda: 1 / 0)


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "stopped by SIGTERM"), (signal.SIGHUP, 129, "SIGHUP")],
)
def test_the_first_signal_ends_and_later_ones_change_nothing(
    capsys: pytest.CaptureFixture[str], number: signal.Signals, code: int, words: str
) -> None:
    steps, handler = [], signal.getsignal(number)

    def action() -> None:
        try:
            steps.append("begun")
            signal.raise_signal(number)
            steps.append("not reached")
        finally:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            steps.append("finished")

    got, line = answer(capsys, action, None)
    assert (got, steps) == (code, ["begun", "finished"])
    assert words in line
    assert signal.getsignal(number) == handler


@pytest.mark.parametrize("found", [SystemError, RuntimeError, ZeroDivisionError])
def test_what_compiled_code_makes_of_a_signal(capsys: pytest.CaptureFixture[str], found: type[Exception]) -> None:
    """numba's dispatcher raises a SystemError. Another error, of the cleaning up, is not hidden."""

    def action() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as stop:
            raise found from stop

    if found is ZeroDivisionError:
        with pytest.raises(found):
            execute("prog", action)
    else:
        assert answer(capsys, action, None) == (143, "prog: stopped by SIGTERM")


def test_what_must_be_finished_is_finished_first(capsys: pytest.CaptureFixture[str]) -> None:
    steps = []

    def action() -> None:
        with uninterrupted():
            signal.raise_signal(signal.SIGTERM)
            steps.append("finished")
        steps.append("not reached")

    assert answer(capsys, action, None) == (143, "prog: stopped by SIGTERM")
    assert steps == ["finished"]


def test_a_signal_that_is_ignored_stays_ignored(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        assert answer(capsys, lambda: signal.raise_signal(signal.SIGHUP), None) == (0, "")
    finally:
        signal.signal(signal.SIGHUP, before)


def python(code: str, **options) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=options.get("stdout", subprocess.PIPE),
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[1],
    )


def test_imports_are_broken_off_at_once_and_with_one_line() -> None:
    code = (
        "import time\n"
        "from torchfsid.commands.command_line import execute\n"
        "from torchfsid.commands.interruption import importing\n"
        "def action():\n"
        "    with importing():\n"
        "        print('importing', flush=True)\n"
        "        try:\n"
        "            time.sleep(60)\n"
        "        except BaseException:\n"
        "            print('a module saw an exception', flush=True)\n"
        "execute('prog', action)\n"
    )
    process = python(code)
    assert process.stdout is not None
    assert process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=30)
    assert (out, errors, process.returncode) == ("", "prog: interrupted\n", 130)


@pytest.mark.parametrize("target", ["closed pipe", "/dev/full"])
def test_a_table_that_nobody_reads(target: str) -> None:
    """A reader who leaves, as `head` does, is no failure; a full disk is, and is named."""
    code = (
        "import sys\n"
        "from torchfsid.commands.command_line import execute\n"
        "from torchfsid.commands.terminal import console\n"
        "def action():\n"
        "    shown = console()\n"
        "    for _ in range(1000):\n"
        "        shown.print('a line of a table' * 8)\n"
        "sys.exit(execute('prog', action))\n"
    )
    if target == "closed pipe":
        process = python(code)
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr is not None
        errors = process.stderr.read()
        assert (process.wait(timeout=60), errors) == (0, "")
    else:
        with open(target, "w") as full:
            _, errors = python(code, stdout=full).communicate(timeout=60)
        assert errors == "prog: standard output: No space left on device\n"


def test_progress_that_cannot_be_shown_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        encoding = "utf-8"

        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        def flush(self) -> None:
            raise BrokenPipeError

        def isatty(self) -> bool:
            return False

    monkeypatch.setattr(sys, "stderr", Full())
    with status("Working"):
        pass
    assert list(track(range(5), "Counting", total=5)) == [0, 1, 2, 3, 4]


def test_times_since_1970_keep_their_milliseconds() -> None:
    assert seconds(1763000000.125) == "1763000000.125 s"
    assert seconds(0.1 + 0.2) == "0.3 s"
    assert seconds(4 / 3) == "1.3333 s"


@pytest.mark.parametrize(
    ("value", "resolution", "text"),
    [
        (1.23456789, 1.0, "1.23"),
        (0.123456789, 0.3, "0.123"),
        (448262.123456789, 0.002, "448262.1235"),
        (5411932.5, 2e-3, "5411932.5"),
        (448262.1, 1e3, "4.483e+05"),
        (-3.5e-15, 10.0, "0"),
        (0.0, 0.0, "0"),
        (2.5, 0.0, "2.5"),
        (1 / 3, 0.0, "0.33333333333333"),
        (float("nan"), 1.0, "-"),
        (float("inf"), 1.0, "inf"),
        (1.23456789, float("nan"), "1.235"),
        (1.23456789, float("inf"), "1.235"),
    ],
)
def test_digits_enough_to_find_a_point_in_its_set(value: float, resolution: float, text: str) -> None:
    assert digits(value, resolution) == text
    if math.isfinite(value) and math.isfinite(resolution):
        assert abs(float(text) - value) <= max(resolution / 10, 1e-12 * abs(value))


def test_a_narrow_terminal_shows_every_digit() -> None:
    shown = io.StringIO()
    made = table("places", ["robot"], ["volume", "diameter", "centroid", "centre", "radius"])
    point = "(448262.1235, 5411932.123)"
    made.add_row("r0", "3.53e-05", "0.0068", point, point, "0.00333")
    Console(file=shown, width=80).print(made)
    text = shown.getvalue()
    assert "…" not in text
    for number in ("3.53e-05", "0.0068", "448262.1235", "5411932.123", "0.00333"):
        assert number in text


def test_names_and_units_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    made = table(":smile: [m/s]", ["robot [m]"], ["worst [m]"])
    made.add_row(escape(":smile:"), escape("[bold]"))
    console().print(made)
    text = capsys.readouterr().out
    for word in (":smile: [m/s]", "robot [m]", "worst [m]", "│ :smile:", "[bold]"):
        assert word in text
    aside().print(":smile:")
    assert capsys.readouterr().err == ":smile:\n"


@pytest.mark.parametrize("main", [torchfsid.cli.main, experiments.__main__.main])
def test_without_a_command_the_commands_are_named(
    main: Callable[[Sequence[str]], int], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([])
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "{init,observe,check,schema,report}" in error or "{run,sweep,design,figures,report}" in error


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_stream_is_nowhere(monkeypatch: pytest.MonkeyPatch, stream: str) -> None:
    """`program >&-`: Python then has no stream at all."""
    monkeypatch.setattr(sys, stream, None)
    assert execute("prog", lambda: print("x")) == 0
