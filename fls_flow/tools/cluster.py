"""Cells on a Dask cluster: for archives and Monte Carlo runs that outgrow a machine."""

from __future__ import annotations

import importlib
import logging
import threading
import uuid
from collections import deque
from collections.abc import Generator, Sequence
from typing import Any

from fls_flow.errors import RunError, UserError
from fls_flow.tools.cell import Row, Task, run_cell

__all__ = ["on_cluster"]

log = logging.getLogger(__name__)

CONNECT_S = 10.0
AHEAD = 3  # tasks per thread that the scheduler holds: few enough that a stop is quick

# The number of numerical threads is one setting of a whole process, so its cells take turns.
_TURN = threading.Lock()


def on_cluster(tasks: Sequence[Task], address: str) -> Generator[Row, None, None]:
    """The rows of the tasks in the order in which they end; drops what is not done when it is closed.

    Raises UserError when no cluster with workers answers at `address`, RunError when it is lost on the way.
    """
    client = _client(address)
    try:
        yield from _rows(client, deque(tasks), address)
    finally:
        client.close()


def _distributed() -> Any:
    return importlib.import_module("distributed")  # partly typed: as Any


def in_turn(task: Task) -> Row:
    """The row of a task, on a worker that may have several threads."""
    with _TURN:
        return run_cell(task)


def _client(address: str) -> Any:
    try:
        distributed = _distributed()
    except ImportError as error:
        raise UserError("--dask needs the package distributed: pip install 'fls-flow[dask]'") from error
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        text = " ".join(str(error).split())
        raise UserError(
            f"--dask {address}: no scheduler answers there ({text}); start one with `dask scheduler`"
        ) from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        client.close()
        raise UserError(
            f"--dask {address}: the cluster has no workers; start some with `dask worker {address}`"
        ) from error
    return client


def _rows(client: Any, waiting: deque[Task], address: str) -> Generator[Row, None, None]:
    threads = client.nthreads()
    if any(n > 1 for n in threads.values()):
        log.warning("workers with several threads do one cell at a time; start them with --nthreads 1")
    run = uuid.uuid4().hex[:8]
    indices: dict[str, int] = {}

    def submitted() -> Any:
        task = waiting.popleft()
        key = f"fls-sweep-{run}-{task.index}"
        indices[key] = task.index
        return client.submit(in_turn, task, key=key, pure=False, retries=0)

    ahead = min(len(waiting), AHEAD * sum(threads.values()))
    running = _distributed().as_completed([submitted() for _ in range(ahead)], loop=client.loop)
    for future in running:
        row = _row(client, future, indices.pop(future.key), address)
        future.release()
        if waiting:
            running.add(submitted())
        yield row


def _row(client: Any, future: Any, index: int, address: str) -> Row:
    try:
        row: Row = future.result()
    except Exception as error:  # whatever a worker or the scheduler says
        if client.status != "running" or future.cancelled():
            raise RunError(f"--dask {address}: the scheduler was lost; the same command goes on") from error
        text = " ".join(str(error).split())
        return Row(index, "failed", error=f"{type(error).__name__}: {text}")
    return row
