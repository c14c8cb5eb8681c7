"""`fls-flow draw`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fls_flow.cli.common import SET, USE, load
from fls_flow.errors import UserError

__all__ = ["draw"]


@click.command()
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

    checked = load(graph, options)
    form = form or ("svg" if output is not None and output.suffix == ".svg" else "mermaid")
    text = drawing.svg(checked) if form == "svg" else drawing.mermaid(checked)
    if output is None:
        click.echo(text, nl=False)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}") from error
