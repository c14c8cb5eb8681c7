"""`fls-flow plugins`."""

from __future__ import annotations

import inspect
import json
import math
import re
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, screen

if TYPE_CHECKING:
    from fls_flow.catalog import Kind

__all__ = ["plugins"]


@click.command()
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
            screen(stderr=False).print(console.kinds_table(listings))
        return
    found = catalog.load(kind)
    if as_json:
        click.echo(json.dumps(_kind_document(found)))
        return
    terminal = screen(stderr=False)
    terminal.print(f"[bold]{kind}[/bold]  ({found.role}, {found.listing.module if found.listing else ''})\n")
    terminal.print(_flowing(inspect.getdoc(found.cls) or ""), markup=False, highlight=False)
    terminal.print()
    terminal.print(console.kind_table(found))


def _flowing(text: str) -> str:
    """The text with a line per paragraph, for the terminal to break; indented lines stay as they are."""
    return re.sub(r"(?<=\S)\n(?=\S)", " ", text)


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
        "takes_any": None if found.takes_any is None else found.takes_any.__name__,
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
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, bool | int | str)
