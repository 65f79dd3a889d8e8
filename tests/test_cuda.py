"""The kernels for a GPU, on a CPU: numba's simulator runs them where it is asked for before numba is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchfsid import device
from torchfsid.kernels.cuda import launch


def test_on_the_simulator() -> None:
    """All tests in `on_simulator`, in a process of their own."""
    tests = sorted(map(str, Path(__file__).with_name("on_simulator").glob("[!_]*.py")))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=Path(__file__).parent.parent)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_name_that_numpy_has_dropped_is_lent(monkeypatch: pytest.MonkeyPatch) -> None:
    """numba-cuda finds `row_stack` while it is imported, and numpy is as it was after that."""
    found: list[bool] = []
    monkeypatch.delattr(np, "row_stack", raising=False)
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(launch.importlib, "import_module", lambda name: found.append("row_stack" in vars(np)))
    launch.probe()
    assert found == [True]
    assert "row_stack" not in vars(np)


@pytest.fixture
def anew() -> None:
    device.missing.cache_clear()


@pytest.mark.usefixtures("anew")
def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on the CPU never take the kernels of the device. What is missing for the others is said in words."""
    numbers = torch.zeros(2)
    assert not device.has_kernels(numbers)

    class Broken:
        @staticmethod
        def probe() -> None:
            return np.no_such_function  # type: ignore[attr-defined]

    monkeypatch.setattr(device, "import_module", lambda name: Broken)
    try:
        reason = device.missing()
    finally:
        device.missing.cache_clear()
    assert "no_such_function" in reason
    assert "torchfsid[cuda]" in reason
