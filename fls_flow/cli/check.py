"""`fls-flow check`."""

from __future__ import annotations

import json
from typing import Any

import click

from fls_flow.cli.common import JSON, SET, USE, load, show
from fls_flow.errors import GraphError, Problem, UserError

__all__ = ["check"]


@click.command()
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
            checked = load(name, options)
        except UserError as error:
            failed = error.exit_code
            results.append({"graph": name, "ok": False, "problems": _documents(name, error), "notes": []})
            if not as_json:
                show(error, debug=False)
        else:
            results.append({"graph": name, "ok": True, "problems": [], "notes": list(checked.notes)})
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
