"""Who works on a sweep: cores of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from torchfsid.errors import ConfigError, FsidError, one_line

DASK_TIMEOUT = 10
"""To reach a scheduler [s]."""

Workers = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]
"""(function, arguments of each call) -> results, as they come."""


class WorkersError(FsidError):
    """The workers have gone: what was done before stands."""


@contextmanager
def workers(jobs: int = 1, dask: str | None = None) -> Iterator[Workers]:
    """Workers for a while.

    Args:
        jobs: processes on this machine; -1: one per core.
        dask: address of a Dask scheduler to use instead.

    Raises:
        ConfigError: joblib or Dask is not installed, or there is no such scheduler.
        WorkersError: the cluster has broken down.
    """
    try:
        import joblib
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}: install torchfsid[experiments]") from error

    def work(function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        # In larger batches, finished runs would wait for others and be lost with them. (joblib annotates it as a text.)
        parallel = joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator_unordered")  # type: ignore[arg-type]
        yield from parallel(joblib.delayed(function)(*call) for call in calls)  # type: ignore[misc]

    if dask is None:
        yield work
        return
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise ConfigError("--dask: install torchfsid[dask]") from error
    try:
        client = Client(dask, timeout=DASK_TIMEOUT)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--dask {dask}: {one_line(error)}") from error
    with client, joblib.parallel_config(backend="dask", client=client):
        yield work
