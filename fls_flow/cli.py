"""The `fls-flow` command: one thin function per verb.

Exit code 0 if all went well, 2 for a mistake in what the user wrote, 1 for a failure at run time, 130 after
Ctrl-C. Each verb imports what it needs: `fls-flow --help` loads no numerics.
"""

from __future__ import annotations

import inspect
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fls_flow.errors import FlsFlowError, GraphError, Problem, UserError

if TYPE_CHECKING:
    from rich.console import Console

    from fls_flow.catalog import Kind
    from fls_flow.graph import Graph
    from fls_flow.runtime import Options, Report, Run, RunFolder

__all__ = ["main"]

USE = click.option("--use", multiple=True, metavar="NODE=KIND", help="Swap the kind of a node. Repeatable.")
SET = click.option(
    "--set", "set_", multiple=True, metavar="NODE.PARAM=VALUE", help="Set a parameter. Repeatable."
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fls-flow", prog_name="fls-flow")
@click.option("--debug", is_flag=True, help="Show tracebacks and debug messages.")
def cli(debug: bool) -> None:
    """Forward-looking sonar, from pings to tracked obstacles.

    \b
    Example:
      fls-flow run surface_obstacle
    """


def main() -> None:
    """Run the command line; every error is one line, with a traceback only for --debug."""
    debug = "--debug" in sys.argv[1:]
    if debug:  # wherever it stands
        sys.argv = [sys.argv[0], "--debug", *(word for word in sys.argv[1:] if word != "--debug")]
    try:
        sys.exit(cli(standalone_mode=False) or 0)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.exceptions.Abort:
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # whoever read has had enough
        sys.exit(1)
    except FlsFlowError as error:
        _show(error, debug)
        sys.exit(error.exit_code)
    except Exception as error:
        _show(error, debug)
        sys.exit(1)


def _show(error: Exception, debug: bool) -> None:
    if debug:
        traceback.print_exception(error)
    if isinstance(error, GraphError):
        lines = [str(problem) for problem in error.problems]
    elif isinstance(error, FlsFlowError):
        lines = [str(error)]
    else:
        text = " ".join(str(error).split())
        lines = [f"internal error: {type(error).__name__}: {text}; --debug shows where"]
    for line in lines:
        click.echo(f"error: {line}", err=True)


@cli.command()
@click.argument("graph")
@click.option("--in-process", is_flag=True, help="Run all nodes in this process (so far the only way).")
@click.option("--in-order", is_flag=True, help="One node after the other instead of a thread each.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the run [runs/GRAPH/UTC-TIME].")
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
    from fls_flow import console, runtime

    checked = _load(graph, options)
    settings = _settings(options)
    folder = runtime.RunFolder.create(checked, options["out"])
    screen, as_json = _console(stderr=True), options["as_json"]
    if not as_json:
        click.echo(f"writing to {folder.path}", err=True)
    debug = bool(context.find_root().params["debug"])
    with folder.logging(), console.log_to(screen, debug=debug):
        report = _run(checked, settings, folder, screen, shown=not (as_json or options["no_progress"]))
    if as_json:
        document = {"out": str(folder.path), "figures": console.headline(checked, report), **report.summary()}
        click.echo(json.dumps(document))
    else:
        _print_report(checked, report, folder.path)
    if report.error is not None:
        raise report.error
    return 130 if report.status == "interrupted" else 0


def _settings(options: dict[str, Any]) -> Options:
    from fls_flow.runtime import Options

    taken: dict[str, Any] = {}
    if options["repeat"] is not None:
        try:
            taken = json.loads(options["repeat"].read_text(encoding="utf-8"))["samples_taken"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"--repeat {options['repeat']}: is no run.json of a run that ended") from error
    try:
        return Options(options["window"], options["rate"], options["in_order"], samples_taken=taken)
    except ValueError as error:
        raise UserError(f"--{error}") from error


def _run(checked: Graph, settings: Options, folder: RunFolder, screen: Console, *, shown: bool) -> Report:
    from fls_flow import console, runtime

    occupied = folder.occupied(checked)
    if occupied:
        (folder.path / "run.json").unlink()
        raise UserError(f"{occupied[0]}: is there already; name another --out folder")
    began = _now()
    count: list[Callable[[int], None]] = []
    one = runtime.Run(checked, settings, out=folder.path, on_finished=lambda pings: count[0](pings))
    about = {"run": one.id, "began": began, "window": one.window, **runtime.describe(checked)}
    folder.record({"status": "running", **about})
    with console.progress(screen, one.total, shown=shown) as counting, _stopped_by_signals(one):
        count.append(counting)
        report = one.start()
    folder.record({**about, "ended": _now(), **report.summary()})
    return report


def _now() -> str:
    import datetime

    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


@contextmanager
def _stopped_by_signals(one: Run) -> Iterator[None]:
    """The first Ctrl-C or SIGTERM stops the run cleanly, the second at once."""

    def stop(number: int, frame: Any) -> None:
        signal.signal(number, signal.default_int_handler)
        one.stop()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except KeyboardInterrupt:
        raise click.exceptions.Abort from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _print_report(checked: Graph, report: Report, out: Path) -> None:
    from fls_flow import console

    screen = _console(stderr=False)
    screen.print(console.nodes_table(checked, report))
    figures = console.headline(checked, report)
    screen.print("  ".join(f"[bold]{name}[/bold] {value:,}" for name, value in figures.items()))
    screen.print(
        f"{report.status}; wrote {', '.join(_written(out))} in {out}", soft_wrap=True, highlight=False
    )


def _written(out: Path) -> list[str]:
    return sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())


def _console(*, stderr: bool) -> Console:
    from rich.console import Console

    return Console(stderr=stderr)


def _load(name: str, options: dict[str, Any]) -> Graph:
    from fls_flow import graph

    checked = graph.load(name, use=options["use"], set_=options["set_"])
    for note in checked.notes:
        click.echo(f"note: {note}", err=True)
    return checked


@cli.command()
@click.argument("graphs", nargs=-1, required=True)
@USE
@SET
@JSON
def check(graphs: tuple[str, ...], as_json: bool, **options: Any) -> int:
    """Find every mistake in GRAPHS without running them.

    \b
    Example:
      fls-flow check graphs/*.yaml
    """
    failed = 0
    results = []
    for name in graphs:
        try:
            checked = _load(name, options)
        except UserError as error:
            failed = error.exit_code
            results.append({"graph": name, "ok": False, "problems": _documents(name, error)})
            if not as_json:
                _show(error, debug=False)
        else:
            results.append({"graph": name, "ok": True, "problems": []})
            if not as_json:
                nodes = ", ".join(node.name for node in checked.nodes)
                click.echo(f"{name}: ok: {len(checked.nodes)} nodes ({nodes}), clock {checked.clock}")
    if as_json:
        click.echo(json.dumps(results))
    return failed


def _documents(name: str, error: UserError) -> list[dict[str, str]]:
    problems = [Problem(name, str(error).removeprefix(f"{name}: "))]
    if isinstance(error, GraphError):
        problems = list(error.problems)
    return [{"where": problem.where, "what": problem.what} for problem in problems]


@cli.command()
@click.argument("kind", required=False)
@JSON
def plugins(kind: str | None, as_json: bool) -> None:
    """List the installed kinds, or show ports, parameters and documentation of KIND.

    \b
    Example:
      fls-flow plugins rayleigh-cfar
    """
    from fls_flow import console
    from fls_flow.catalog import Catalog

    catalog = Catalog()
    if kind is None:
        listings = catalog.listings()
        if as_json:
            fields = ("kind", "distribution", "version", "module")
            click.echo(json.dumps([{name: getattr(one, name) for name in fields} for one in listings]))
        else:
            _console(stderr=False).print(console.kinds_table(listings))
        return
    found = catalog.load(kind)
    if as_json:
        click.echo(json.dumps(_kind_document(found)))
        return
    screen = _console(stderr=False)
    screen.print(f"[bold]{kind}[/bold]  ({found.role}, {found.listing.module if found.listing else ''})\n")
    screen.print(inspect.getdoc(found.cls) or "", markup=False, highlight=False)
    screen.print()
    screen.print(console.kind_table(found))


def _kind_document(found: Kind) -> dict[str, Any]:
    from fls_flow.parameters import type_name

    return {
        "kind": found.name,
        "role": found.role,
        "doc": inspect.getdoc(found.cls),
        "inputs": [
            {
                "name": port.name,
                "message": port.message.__name__,
                "optional": port.optional,
                "previous": port.nullable,
                "time": port.stream,
            }
            for port in found.inputs
        ],
        "outputs": [{"name": port.name, "message": port.message.__name__} for port in found.outputs],
        "parameters": [
            {
                "name": one.name,
                "type": type_name(one.annotation),
                "required": one.required,
                "default": None
                if one.required
                else one.default
                if _is_json(one.default)
                else str(one.default),
            }
            for one in found.parameters
        ],
    }


def _is_json(value: Any) -> bool:
    return value is None or isinstance(value, bool | int | float | str)


@cli.command()
@click.argument("graph")
@click.option(
    "--format", "form", type=click.Choice(["mermaid", "svg"]), help="[by OUTPUT's suffix, or mermaid]"
)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="File to write instead of printing.")
@USE
@SET
def draw(graph: str, form: str | None, output: Path | None, **options: Any) -> None:
    """Draw GRAPH as Mermaid text or as an SVG picture.

    \b
    Example:
      fls-flow draw surface_obstacle -o graph.svg
    """
    from fls_flow import draw as drawing

    checked = _load(graph, options)
    form = form or ("svg" if output is not None and output.suffix == ".svg" else "mermaid")
    text = drawing.svg(checked) if form == "svg" else drawing.mermaid(checked)
    if output is None:
        click.echo(text, nl=False)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}") from error


if __name__ == "__main__":
    main()
