"""Cells in processes of their own on this machine: the death of one costs its cell, no more."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import shutil
import signal
import tempfile
from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess

from fls_flow.runtime.threads import limit_this_thread, limited_threads
from fls_flow.tools.cell import Row, Task, run_cell

__all__ = ["in_processes"]

GRACE_S = 5.0


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: Connection
    task: Task | None = None

    @classmethod
    def start(cls, context: SpawnContext, scratch: str) -> _Worker:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, scratch), daemon=True)
        # Ctrl-C reaches the whole terminal group; only this process shall answer it, and end the others.
        resource_tracker.ensure_running()  # as a part of the start it would let the signal through
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        return cls(process, ours)

    def give(self, task: Task) -> None:
        self.task = task
        with contextlib.suppress(OSError):  # it has died: the next answer says so
            self.pipe.send(task)

    def answer(self) -> Row:
        assert self.task is not None  # only workers with a task are waited for
        try:
            row: Row = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(GRACE_S)
            return Row(self.task.index, "failed", error=f"its process died ({_cause(self.process.exitcode)})")
        self.task = None
        return row

    @property
    def dead(self) -> bool:
        """Whether it gave up its task instead of answering."""
        return self.process.exitcode is not None

    def end(self, *, now: bool) -> None:
        self.pipe.close()
        if now:
            self.process.terminate()
        self.process.join(GRACE_S)
        if self.process.exitcode is None:
            self.process.kill()
            self.process.join()


def in_processes(tasks: Sequence[Task], count: int) -> Generator[Row, None, None]:
    """The rows of the tasks in the order in which they end, `count` at a time, each process on one thread.

    Ends its processes when it is closed or ends.
    """
    context = multiprocessing.get_context("spawn")
    waiting = deque(tasks)
    with tempfile.TemporaryDirectory(prefix="fls-sweep-") as scratch:
        yield from _rows(context, waiting, count, scratch)


def _rows(
    context: SpawnContext, waiting: deque[Task], count: int, scratch: str
) -> Generator[Row, None, None]:
    workers: list[_Worker] = []
    try:
        for _ in range(min(count, len(waiting))):
            workers.append(_Worker.start(context, scratch))
            workers[-1].give(waiting.popleft())
        while busy := {worker.pipe: worker for worker in workers if worker.task is not None}:
            for pipe in wait(list(busy)):
                worker = busy[pipe]  # type: ignore[index]  # wait() gives back what it got
                row = worker.answer()
                if worker.dead:
                    workers.remove(worker)
                    worker.end(now=True)
                    if waiting:
                        workers.append(worker := _Worker.start(context, scratch))
                if waiting:
                    worker.give(waiting.popleft())
                yield row
    finally:
        for worker in workers:
            worker.end(now=worker.task is not None)


def _work(pipe: Connection, scratch: str) -> None:
    """Answer tasks until the pipe closes; what they write for a while lies in `scratch`."""
    tempfile.tempdir = scratch  # a worker that is killed removes nothing
    sweep = multiprocessing.parent_process()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger().addHandler(logging.NullHandler())  # what goes wrong is in the row
    with limited_threads():
        limit_this_thread()
        while True:
            try:
                pipe.send(run_cell(pipe.recv()))
            except (EOFError, OSError):
                if sweep is None or not sweep.is_alive():  # nobody else will
                    shutil.rmtree(scratch, ignore_errors=True)
                return


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"
