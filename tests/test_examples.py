"""Every script in examples/ runs as it is, and its log is the one that its script makes."""

from __future__ import annotations

import csv
import runpy
import shutil
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))


def test_there_are_eight_that_are_read_at_once() -> None:
    assert len(SCRIPTS) == 8
    for script in SCRIPTS:
        assert 30 <= len(script.read_text().splitlines()) <= 60, script.name


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_it_runs(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It writes nothing but into the current folder, and its own assertions hold."""
    before = set(EXAMPLES.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script)])
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out
    assert set(EXAMPLES.rglob("*")) == before


def test_the_log_is_what_its_script_makes(tmp_path: Path) -> None:
    shutil.copy(EXAMPLES / "data" / "make.py", tmp_path)
    runpy.run_path(str(tmp_path / "make.py"), run_name="__main__")
    committed, made = (read(folder / "crossing.csv") for folder in (EXAMPLES / "data", tmp_path))
    assert [row[:2] for row in committed] == [row[:2] for row in made]
    for old, new in zip(committed[1:], made[1:], strict=True):
        assert [float(value) for value in new[2:]] == pytest.approx([float(value) for value in old[2:]], abs=2e-6)


def read(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))
