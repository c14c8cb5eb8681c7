"""What several verbs share: options, errors, the loaded graph."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

import click

from fls_flow.errors import FlsFlowError, GraphError

if TYPE_CHECKING:
    from rich.console import Console

    from fls_flow.graph import Graph

__all__ = ["JSON", "SET", "USE", "load", "printable", "screen", "show"]

USE = click.option("--use", multiple=True, metavar="NODE=KIND", help="Swap the kind of a node. Repeatable.")
SET = click.option(
    "--set", "set_", multiple=True, metavar="NODE.PARAM=VALUE", help="Set a parameter. Repeatable."
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")


def show(error: Exception, debug: bool) -> None:
    """Print an error: one line for each problem, a traceback before them for `debug`."""
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
        click.echo(f"error: {printable(line)}", err=True)


def printable(text: str) -> str:
    """The text on one line, with what a terminal would obey written out."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def screen(*, stderr: bool) -> Console:
    """The terminal."""
    from rich.console import Console

    return Console(stderr=stderr)


def load(name: str, options: dict[str, Any]) -> Graph:
    """The checked graph under `--use` and `--set`; what fell away is told."""
    from fls_flow import graph

    checked = graph.load(name, use=options["use"], set_=options["set_"])
    for note in checked.notes:
        click.echo(f"note: {note}", err=True)
    return checked
