"""What a release says of itself: one version everywhere, and help that shows how to begin."""

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
import yaml

import torchfsid
from torchfsid.cli import main
from torchfsid.outcome import Status

ROOT = Path(torchfsid.__file__).parents[1]


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_one_version(capsys):
    version = torchfsid.__version__
    assert said(capsys, "--version") == f"torchfsid {version}\n"
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    headings = [line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## ")]
    assert headings[0].split()[1] == version


def test_the_module_is_the_command():
    called = subprocess.run(
        [sys.executable, "-m", "torchfsid", "--version"], capture_output=True, text=True, check=True
    )
    assert called.stdout == f"torchfsid {torchfsid.__version__}\n"


def test_the_version_does_not_wait_for_the_rest():
    """Nor do init and schema need PyTorch."""
    code = "import sys, torchfsid.cli, torchfsid.commands.init, torchfsid.config.schema; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_help_says_how_to_begin(capsys):
    """Examples, what the statuses mean, exit codes and how lists are overridden."""
    assert "torchfsid init run.csv" in said(capsys, "--help")
    observe = said(capsys, "observe", "--help")
    for status in (Status.OK, Status.ALARM, Status.INCONSISTENT):
        assert f"\n  {status.name.lower()} " in observe
    assert "exit codes" in observe
    assert "barriers.0" in observe
    assert "prints" in said(capsys, "check", "--help")


def test_the_extras_that_messages_name_exist():
    """`pip install 'torchfsid[ros]'` and the like."""
    extras = set(metadata.metadata("torchfsid").get_all("Provides-Extra") or [])
    assert {"ros", "parquet"} <= extras
