"""`fls-flow evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from fls_flow.cli.common import JSON, screen
from fls_flow.errors import UserError

__all__ = ["evaluate"]


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--truth", type=click.Path(path_type=Path), help="truth.csv, if it is not among FILES.")
@click.option("--plot", type=click.Path(path_type=Path), help="Write a picture (PNG) here.")
@click.option("--cutoff-m", type=float, default=10.0, show_default=True, help="c of OSPA, GOSPA and HOTA.")
@click.option("--order", type=float, default=1.0, show_default=True, help="p of OSPA and GOSPA.")
@click.option(
    "--gate-m", type=float, default=5.0, show_default=True, help="What is this close belongs together."
)
@click.option("--window-pings", type=int, default=10, show_default=True, help="Window of OSPA(2).")
@click.option("--tentative", is_flag=True, help="Score tentative tracks too.")
@click.option("--positive", metavar="CLASS", help="Class of the ROC [the first by name].")
@click.option("--miss-cost", type=float, default=1.0, show_default=True, help="Of missing that class.")
@click.option("--false-alarm-cost", type=float, default=1.0, show_default=True, help="Of wrongly calling it.")
@click.option("--group", "groups", multiple=True, metavar="CLASS=A,B*",
              help="Count classes that match A or B* as CLASS; the first such. Repeatable.")  # fmt: skip
@JSON
def evaluate(
    files: tuple[Path, ...], truth: Path | None, plot: Path | None, as_json: bool, **options: Any
) -> None:
    """Score FILES against truth: tracks, detections, PHD estimates (CSV, a recording, or a run's folder).

    \b
    Examples:
      fls-flow evaluate runs/surface-obstacle/2026-01-31T12-00-00Z
      fls-flow evaluate tracks.csv --truth truth.csv --plot scores.png
      fls-flow evaluate run/ --positive diver --miss-cost 10 --group "marine-life=seal,dolphin,fish"
    """
    from fls_flow.evaluate import Settings, find, report, score
    from fls_flow.evaluate.classifier import parse_group

    options["groups"] = tuple(parse_group(one) for one in options["groups"])
    try:
        settings = Settings(**options)
    except ValueError as error:
        name, rest = str(error).split(" ", 1)
        raise UserError(f"--{name.replace('_', '-')} {rest}") from error
    chosen = find(files, truth)
    with screen(stderr=True).status("scoring"):
        scores = score(
            chosen.tracks,
            chosen.truth,
            detections=chosen.detections,
            estimates=chosen.estimates,
            settings=settings,
        )
    if plot is not None:
        from fls_flow.evaluate import picture

        picture.draw(scores, plot)
    if as_json:
        click.echo(json.dumps(report.document(scores)))
        return
    terminal = screen(stderr=False)
    for table in report.tables(scores):
        terminal.print(table)
        terminal.print()
    for note in scores.notes:
        click.echo(f"note: {note}", err=True)
    if plot is not None:
        click.echo(f"wrote {plot}", err=True)
