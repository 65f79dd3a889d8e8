"""What every test shares."""

import signal
from collections.abc import Iterator

import jaxtyping
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from tests import calls

# On tensors this small torch is many times slower with more threads. They are no part of what is tested.
torch.set_num_threads(1)

# A shell's background job ignores SIGINT, and nohup SIGHUP, and both hand this down to the commands under test.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(autouse=True)
def checked_anew() -> Iterator[None]:
    """Types are checked in every test, and in the fixtures that several of them share."""
    calls.clear()
    yield
    calls.clear()


@pytest.fixture
def unchecked() -> Iterator[None]:
    """No shape annotations are checked: what remains is what a user meets."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are laid out and drawn in seconds, which is tested elsewhere: here they are files of one byte."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **options: file.write(b"."))
    monkeypatch.setattr(Figure, "draw_without_rendering", lambda figure: None)
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: None)
