"""`fls-flow check`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, SET, USE, load, show
from fls_flow.errors import GraphError, Problem, UserError

if TYPE_CHECKING:
    from fls_flow.deploy import Deployment
    from fls_flow.graph import Graph

__all__ = ["check"]


@click.command()
@click.argument("graphs", nargs=-1, required=True)
@click.option("--deploy", metavar="FILE", help="Check that deployment of each graph too.")
@click.option("--host", metavar="NAME", help="With --deploy: look at this host's certificates and passwords.")
@USE
@SET
@JSON
def check(graphs: tuple[str, ...], as_json: bool, **options: Any) -> int:
    """Find every mistake in GRAPHS without running them.

    \b
    Example:
      fls-flow check graphs/*.yaml
      fls-flow check surface_obstacle --deploy mtls --host vehicle
    """
    if options["host"] and not options["deploy"]:
        raise UserError("--host: name the deployment with --deploy")
    failed = 0
    results = []
    for name in graphs:
        try:
            checked = load(name, options)
            deployment = _deployment(checked, options)
        except UserError as error:
            failed = error.exit_code
            results.append({"graph": name, "ok": False, "problems": _documents(name, error), "notes": []})
            if not as_json:
                show(error, debug=False)
        else:
            notes = [*checked.notes, *(deployment.notes if deployment else ())]
            results.append({"graph": name, "ok": True, "problems": [], "notes": notes})
            if not as_json:
                nodes = ", ".join(node.name for node in checked.nodes)
                click.echo(f"{name}: ok: {len(checked.nodes)} nodes ({nodes}), clock {checked.clock}")
                for line in _places(deployment) if deployment else ():
                    click.echo(line)
    if as_json:
        click.echo(json.dumps(results))
    return failed


def _deployment(checked: Graph, options: dict[str, Any]) -> Deployment | None:
    """The deployment that was asked for; its notes are told."""
    if not options["deploy"]:
        return None
    from fls_flow import deploy

    found = deploy.load(options["deploy"], checked, host=options["host"])
    for note in found.notes:
        click.echo(f"note: {note}", err=True)
    return found


def _places(deployment: Deployment) -> list[str]:
    """A line per process: where it runs, and what is in it."""
    lines = [f"  deployment {deployment.name}, led by host {deployment.leader}"]
    for host in deployment.hosts:
        lines += [f"  {host}: {group.name}: {', '.join(group.nodes)}" for group in deployment.groups(host)]
        lines += [] if deployment.groups(host) else [f"  {host}: router"]
    return lines


def _documents(name: str, error: UserError) -> list[dict[str, str]]:
    problems = [Problem(name, str(error).removeprefix(f"{name}: "))]
    if isinstance(error, GraphError):
        problems = list(error.problems)
    return [{"where": problem.where, "what": problem.what} for problem in problems]
