"""`fls-flow run`."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, SET, USE, load, screen
from fls_flow.errors import RunError, UserError

if TYPE_CHECKING:
    from rich.console import Console

    from fls_flow.deploy import Deployment
    from fls_flow.graph import Graph
    from fls_flow.nursery import Nursery
    from fls_flow.runtime import Options, Report, Run, RunFolder
    from fls_flow.supervisor import Supervisor

__all__ = ["run"]


@click.command()
@click.argument("graph")
@click.option("--in-process", is_flag=True, help="Run all nodes in this process instead of one each.")
@click.option("--in-order", is_flag=True, help="In this process, one node after the other.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the run [runs/GRAPH/UTC-TIME].")
@click.option("--deploy", metavar="FILE", help="Deployment that says which node runs where.")
@click.option("--host", help="Run this host's share of the deployment.")
@click.option("--window", type=click.IntRange(1, 1000), help="Pings in flight [8; live 2].")
@click.option("--rate", type=float, help="Replay at this multiple of real time, shedding like a live sonar.")
@click.option("--repeat", type=click.Path(path_type=Path), help="run.json of a live run to repeat.")
@click.option("--no-progress", is_flag=True, help="No progress bar.")
@USE
@SET
@JSON
@click.pass_context
def run(context: click.Context, /, graph: str, **options: Any) -> int:
    """Run GRAPH, a file or the name of a shipped graph.

    \b
    Examples:
      fls-flow run surface_obstacle
      fls-flow run graphs/surface_obstacle.yaml --set sonar.sequence=passenger-boat --out runs/iv
      fls-flow run surface_obstacle --use cfar=acme-peaks --rate 1
    """
    with _nursery(options) as nursery:
        return _run_with(context, graph, options, nursery)


@contextmanager
def _nursery(options: dict[str, Any]) -> Iterator[Nursery | None]:
    """The process that will fork the others, loading already; None to run in this process."""
    if options["in_process"] or options["in_order"]:
        yield None
        return
    if not sys.platform.startswith("linux"):
        click.echo("note: processes need Linux; running in this process", err=True)
        yield None
        return
    from fls_flow.nursery import Nursery

    nursery = Nursery()
    try:
        yield nursery
    finally:
        nursery.kill()


def _run_with(context: click.Context, graph: str, options: dict[str, Any], nursery: Nursery | None) -> int:
    from fls_flow import console, runtime

    checked = load(graph, options)
    settings = _settings(options)
    deployment, host = _deployment(checked, options)
    folder = runtime.RunFolder.create(checked, options["out"])
    terminal, as_json = screen(stderr=True), options["as_json"]
    if not as_json:
        click.echo(f"writing to {folder.shown}", err=True)
    debug = bool(context.find_root().params["debug"])
    with folder.logging(), console.log_to(terminal, debug=debug):
        shown = not (as_json or options["no_progress"])
        report = _run(checked, settings, folder, terminal, nursery, deployment, host, shown=shown)
    if as_json:
        document = {
            "out": str(folder.shown),
            "figures": console.headline(checked, report),
            **report.summary(),
        }
        click.echo(json.dumps(document))
    else:
        _print_report(checked, report, folder)
    if report.error is not None:
        raise report.error
    return 130 if report.status == "interrupted" else 0


def _deployment(checked: Graph, options: dict[str, Any]) -> tuple[Deployment, str]:
    """Where the nodes run, and which host this is."""
    from fls_flow import deploy

    host: str | None = options["host"]
    if options["deploy"] is None:
        if host is not None:
            raise UserError(f"--host {host}: needs --deploy FILE, which says what runs there")
        return deploy.local(checked), deploy.LOCAL
    if options["in_process"] or options["in_order"]:
        raise UserError("--deploy says where processes run; leave out --in-process and --in-order")
    deployment = deploy.load(options["deploy"], checked, host=host)
    for note in deployment.notes:
        click.echo(f"note: {note}", err=True)
    if host is None and len(deployment.hosts) == 1:
        return deployment, deployment.hosts[0]
    if host not in deployment.hosts:
        known = ", ".join(deployment.hosts)
        said = "say which of them this is" if host is None else f"has no host '{host}'"
        raise UserError(f"--deploy {options['deploy']}: {said}: --host {known.replace(', ', ' | ')}")
    return deployment, host


def _settings(options: dict[str, Any]) -> Options:
    from fls_flow.runtime import Options

    taken: dict[str, Any] = {}
    if options["repeat"] is not None:
        try:
            taken = json.loads(options["repeat"].read_text(encoding="utf-8"))["samples_taken"]
            taken = {
                node: {port: [int(one) for one in numbers] for port, numbers in ports.items()}
                for node, ports in taken.items()
            }
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise UserError(f"--repeat {options['repeat']}: is no run.json of a run that ended") from error
    try:
        return Options(options["window"], options["rate"], options["in_order"], samples_taken=taken)
    except ValueError as error:
        raise UserError(f"--{error}") from error


def _run(
    checked: Graph,
    settings: Options,
    folder: RunFolder,
    terminal: Console,
    nursery: Nursery | None,
    deployment: Deployment,
    host: str,
    *,
    shown: bool,
) -> Report:
    from fls_flow import console, runtime

    occupied = folder.occupied(checked)
    if occupied:
        (folder.path / "run.json").unlink()
        raise UserError(f"{occupied[0]}: is there already; name another --out folder")
    about = {"began": _now(), **runtime.describe(checked)}
    count: list[Callable[[int], None]] = []
    try:
        one = _prepared(checked, settings, folder, nursery, deployment, host, lambda pings: count[0](pings))
        about = {"run": one.id, "window": one.window, **about}
        folder.record({"status": "running", **about})
        with console.progress(terminal, one.total, shown=shown) as counting, _stopped_by_signals(one):
            count.append(counting)
            report = one.start()
    except BaseException as error:
        with contextlib.suppress(RunError):  # the disk may be full: what ended the run is what to tell
            folder.record({**about, **_cut_short(error)})
        raise
    about |= {"run": one.id, "window": one.window}  # a host that does not lead has learnt them
    try:
        folder.record({**about, "ended": _now(), **report.summary()})
    except RunError as error:  # a full disk has most likely ended the run already: that is the one to tell
        report.error = report.error or error
    return report


def _cut_short(error: BaseException) -> dict[str, Any]:
    """What `run.json` says of a run that ended without a report."""
    if isinstance(error, click.exceptions.Abort | KeyboardInterrupt):
        return {"status": "interrupted", "error": "stopped at once by a second signal", "ended": _now()}
    return {"status": "failed", "error": str(error) or type(error).__name__, "ended": _now()}


def _prepared(
    checked: Graph,
    settings: Options,
    folder: RunFolder,
    nursery: Nursery | None,
    deployment: Deployment,
    host: str,
    on_finished: Callable[[int], None],
) -> Run | Supervisor:
    if nursery is None:
        from fls_flow.runtime import Run

        return Run(checked, settings, out=folder.path, on_finished=on_finished)
    from fls_flow.supervisor import Supervisor

    return Supervisor(
        checked, deployment, settings, nursery, host=host, out=folder.path, on_finished=on_finished
    )


def _now() -> str:
    import datetime

    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


@contextmanager
def _stopped_by_signals(one: Run | Supervisor) -> Iterator[None]:
    """The first Ctrl-C, SIGTERM or hang-up of the terminal stops the run cleanly, the second at once."""

    def stop(number: int, frame: Any) -> None:
        signal.signal(number, signal.default_int_handler)
        one.stop()

    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # nohup
    numbers = [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]
    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    except KeyboardInterrupt:
        raise click.exceptions.Abort from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _print_report(checked: Graph, report: Report, out: RunFolder) -> None:
    from fls_flow import console

    terminal = screen(stderr=False)
    terminal.print(console.nodes_table(checked, report))
    figures = console.headline(checked, report)
    terminal.print("  ".join(f"[bold]{name}[/bold] {value:,}" for name, value in figures.items()))
    terminal.print(
        f"{report.status}; wrote {', '.join(_written(out.path))} in {out.shown}",
        soft_wrap=True,
        highlight=False,
    )


def _written(out: Path) -> list[str]:
    return sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
