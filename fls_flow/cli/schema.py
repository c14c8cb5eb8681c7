"""`fls-flow schema`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from fls_flow.cli.common import JSON

if TYPE_CHECKING:
    from fls_flow.catalog import Kind

__all__ = ["schema"]


@click.command()
@click.argument("of", type=click.Choice(["graph", "deployment"]), default="graph")
@JSON
def schema(of: str, as_json: bool) -> None:
    """Print the JSON Schema of graph files, or of deployment files, for editors.

    That of graphs knows the kinds that are installed now; print it again after installing others.
    --json: on one line.

    \b
    Example:
      fls-flow schema > graph.schema.json
      and in the first line of a graph file:
      # yaml-language-server: $schema=graph.schema.json
    """
    from fls_flow.deploy import schema as of_deployments
    from fls_flow.graph import schema as of_graphs

    document = of_graphs.schema(_kinds()) if of == "graph" else of_deployments.schema()
    click.echo(json.dumps(document, indent=None if as_json else 2, ensure_ascii=False))


def _kinds() -> list[Kind]:
    """The installed kinds; one that cannot be loaded is told, and left out."""
    from fls_flow.catalog import Catalog
    from fls_flow.errors import PluginError

    catalog, found = Catalog(), []
    for name in catalog.names():
        try:
            found.append(catalog.load(name))
        except PluginError as error:
            click.echo(f"note: {error}", err=True)
    return found
