"""The workers of a sweep: processes on this computer, or a Dask cluster."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from torchfsid.errors import ConfigError, FsidError, one_line

if TYPE_CHECKING:
    from distributed import Client

DASK_TIMEOUT = 10
"""To reach a scheduler [s]."""

RESUME = "the same command goes on from here"

Workers = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]
"""(function, arguments of each call) -> results, as they come."""


class WorkersError(FsidError):
    """The workers are gone, for lack of memory or because the cluster broke down.

    Finished runs are kept. The same command goes on from there.
    """


@contextmanager
def workers(jobs: int = 1, dask: str | None = None) -> Iterator[Workers]:
    """In this block there are workers.

    Args:
        jobs: number of processes on this computer. -1: one per core.
        dask: address of a Dask scheduler to use instead.

    Raises:
        ConfigError: joblib or Dask is not installed, or there is no such scheduler.
        WorkersError: the cluster broke down.
    """
    if dask is None:
        yield partial(_here, jobs)
        return
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise ConfigError("--dask: install torchfsid[dask]") from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what goes wrong is said in one line, here
    try:
        client = Client(dask, timeout=DASK_TIMEOUT)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--dask {dask}: {one_line(error)}") from error
    with client:
        yield partial(_there, client)


def _here(jobs: int, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    from concurrent.futures.process import BrokenProcessPool

    try:
        import joblib
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}: install torchfsid[experiments]") from error
    # In larger batches, finished runs would wait for others and be lost with them. (joblib annotates it as a text.)
    parallel = joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator_unordered")  # type: ignore[arg-type]
    try:
        yield from parallel(joblib.delayed(function)(*call) for call in calls)  # type: ignore[misc]
    except BrokenProcessPool as error:
        raise WorkersError(f"a process was killed: too little memory?; {RESUME}") from error


def _there(client: Client, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    from concurrent.futures import CancelledError

    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    try:
        for future in as_completed([client.submit(function, *call, pure=False) for call in calls]):
            yield future.result()
            future.release()
    except KilledWorker as error:
        raise WorkersError(f"a run has killed every Dask worker that tried it: too little memory?; {RESUME}") from error
    except (CancelledError, OSError) as error:
        raise WorkersError(f"the Dask scheduler has gone; {RESUME}") from error
