"""What every test shares."""

from collections.abc import Iterator

import jaxtyping
import pytest
import torch

# On tensors this small torch is many times slower with more threads. They are no part of what is tested.
torch.set_num_threads(1)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """No shape annotations are checked: what remains is what a user meets."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
