"""`fls-flow top`."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, screen
from fls_flow.errors import RunError, UserError

if TYPE_CHECKING:
    import zenoh
    from rich.table import Table

__all__ = ["top"]

ANSWER_S = 1.0
CONNECT_S = 3
LOOKS = 5


@click.command()
@click.argument("run", required=False)
@click.option("--connect", metavar="ENDPOINT", help="Ask a run on another machine, e.g. tcp/10.0.0.1:7447.")
@click.option("--every", type=click.FloatRange(min=0.05), default=1.0, show_default=True,
              help="Seconds between two looks.")  # fmt: skip
@click.option("--once", is_flag=True, help="Look once and end.")
@JSON
def top(run: str | None, connect: str | None, every: float, once: bool, as_json: bool) -> None:
    """Show what the nodes of a run are doing: rate, latency, drops, load. RUN is the begin of its id.

    \b
    Examples:
      fls-flow top
      fls-flow top 3f2 --json
      fls-flow top --connect tcp/10.0.0.1:7447
    """
    from fls_flow import local_runs
    from fls_flow.deploy import endpoints
    from fls_flow.runtime.worker import close_session, open_session

    endpoint, which = connect, f"{run}$*" if run else "*"
    if endpoint is not None:
        try:
            endpoints.parse(endpoint)
        except ValueError as error:
            raise UserError(f"--connect {endpoint}: {error}") from error
    else:
        found = local_runs.find(run)
        endpoint, which = found.endpoint, found.run
    key = f"fls/*/{which}/@counters/*"
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": CONNECT_S * 1000,
        "scouting/multicast/enabled": False,
    }
    try:
        session = open_session(settings)
    except Exception as error:
        raise RunError(f"{endpoint}: nobody answers there within {CONNECT_S} s; is the run on?") from error
    try:
        _show(session, key, every, once=once, as_json=as_json)
    except KeyboardInterrupt:
        click.echo(err=True)
    finally:
        close_session(session)


def _show(session: zenoh.Session, key: str, every: float, *, once: bool, as_json: bool) -> None:
    from rich.live import Live

    processes = _asked(session, key)
    if not processes:
        raise RunError("no process of the run answers; has it ended?")
    if as_json or once:
        while True:
            if as_json:
                click.echo(json.dumps(processes))
            else:
                screen(stderr=False).print(_table(processes))
            if once or not processes:
                return
            time.sleep(every)
            processes = _asked(session, key)
    with Live(_table(processes), console=screen(stderr=False), auto_refresh=False) as live:
        while processes:
            time.sleep(every)
            processes = _asked(session, key)
            live.update(_table(processes), refresh=True)


def _asked(session: zenoh.Session, key: str) -> list[dict[str, Any]]:
    """What the processes of the run say; asked a few times, since one look may be too early or too short."""
    found: list[dict[str, Any]] = []
    for _ in range(LOOKS):
        replies = [reply.ok for reply in session.get(key, timeout=ANSWER_S)]
        found = [json.loads(one.payload.to_bytes()) for one in replies if one is not None]
        if found:
            break
        time.sleep(0.1)
    return sorted(found, key=lambda one: (one["host"], one["process"]))


def _table(processes: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    hosts = len({process["host"] for process in processes}) > 1
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in (*(["host"] if hosts else []), "process", "node"):
        table.add_column(name)
    for name in ("pings", "/s", "p50 ms", "p99 ms", "queue", "shed", "drop", "fail", "cpu%", "MiB"):
        table.add_column(name, justify="right", no_wrap=True)
    for process in processes:
        load = [f"{process['cpu'] * 100:.0f}", f"{process['memory_bytes'] / 2**20:.0f}"]
        for name, node in process["nodes"].items():
            times = [f"{node[q]:.2f}" if q in node else "" for q in ("p50_ms", "p99_ms")]
            numbers = [str(node[what]) for what in ("queue", "shed", "dropped", "failed")]
            first = [*([process["host"]] if hosts else []), process["process"], name, str(node["fired"])]
            table.add_row(*first, f"{node['rate_hz']:.1f}", *times, *numbers, *load)
            load = ["", ""]
    return table
