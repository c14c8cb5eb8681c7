"""`fls-flow calibrate`."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, SET, USE, load, screen
from fls_flow.errors import UserError

if TYPE_CHECKING:
    from rich.table import Table

    from fls_flow.graph import Graph
    from fls_flow.tools.calibrate import Calibration
    from fls_flow.tools.calibrate_rates import Measured
    from fls_flow.tools.calibrate_stretch import Stretch

__all__ = ["calibrate"]

CURVE = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)  # of the picture, where measurable


@click.command()
@click.argument("graph")
@click.argument("recording", required=False, type=click.Path(path_type=Path))
@click.option("--node", help="The detector [the only one with a threshold_scale].")
@click.option("--pfa", type=float, default=1e-4, show_default=True, help="The rate of false alarms to meet.")
@click.option("--pings", metavar="A:B", help="Pings without targets, from 0, B excluded [all].")
@click.option("--range-m", metavar="A:B", help="Ranges without targets [all].")
@click.option(
    "--mask", type=click.Path(path_type=Path), help="tracks.csv or truth.csv of targets to leave out."
)
@click.option(
    "--mask-radius-m", type=float, default=1.0, show_default=True, help="What lies this near to one."
)
@click.option("--per-beam", is_flag=True, help="A scale per beam, for sonars whose beams differ.")
@click.option("--extrapolate", is_flag=True, help="Fit the tail where the stretch is too short to count.")
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path),
    default=Path("calibrated.yaml"),
    show_default=True,
    help="The graph to write.",
)
@click.option("--plot", type=click.Path(path_type=Path), help="Write a picture (PNG) of many rates here.")
@click.option("--no-progress", is_flag=True, help="No progress bar.")
@USE
@SET
@JSON
def calibrate(graph: str, recording: Path | None, as_json: bool, **options: Any) -> None:
    """Find the threshold with which a detector of GRAPH meets a rate of false alarms on RECORDING.

    RECORDING takes the place of the path of the graph's source; without it the graph's own source is played.
    There must be no targets in what is measured, or they must be masked.

    \b
    Examples:
      fls-flow calibrate surface_on_recording harbour.npz --pings 0:600 --pfa 1e-5
      fls-flow calibrate graph.yaml still.npz --mask runs/x/tracks.csv --per-beam --plot rates.png
    """
    from fls_flow.tools import calibrate as tool
    from fls_flow.tools import calibrate_overlay, calibrate_picture

    checked = _graph(graph, recording, options)
    out, plot = options["out"], options["plot"]
    for name, path in (("--out", out), ("--plot", plot)):
        if path is not None and path.exists():
            raise UserError(f"{name} {path}: is there already; name another file")
    node = tool.calibratable(checked, options["node"]).name
    found = _calibrated(
        checked, node, _stretch(options), options, shown=not (as_json or options["no_progress"])
    )
    text = calibrate_overlay.overlay(checked, found, out.parent, use=options["use"], set_=options["set_"])
    calibrate_overlay.write(out, text)
    if plot is not None:
        calibrate_picture.draw([(f"{found.node} ({found.kind})", found)], plot)
    if as_json:
        click.echo(json.dumps({"out": str(out), **_document(found)}))
        return
    click.echo(_headline(found))
    screen(stderr=False).print(_table(found))
    click.echo(f"wrote {out}" + (f" and {plot}" if plot is not None else ""), err=True)


def _graph(name: str, recording: Path | None, options: dict[str, Any]) -> Graph:
    checked = load(name, options)
    if recording is None:
        return checked
    clock = checked.node(checked.clock)
    if not any(one.name == "path" for one in clock.kind.parameters):
        raise UserError(
            f"{recording}: source '{clock.name}' ({clock.kind.name}) plays no file; "
            f"name one that does, for example --use {clock.name}=polar-npz"
        )
    quoted = json.dumps(str(recording.absolute()))
    return load(name, {**options, "set_": (*options["set_"], f"{clock.name}.path={quoted}")})


def _stretch(options: dict[str, Any]) -> Stretch:
    from fls_flow.tools.calibrate_stretch import Stretch, targets_of

    pings: tuple[int, int | None] | None = None
    if options["pings"] is not None:
        match = re.fullmatch(r"(\d*):(\d*)", options["pings"])
        if match is None:
            raise UserError(f"--pings {options['pings']}: write it as A:B, for example 0:500")
        pings = int(match[1] or 0), int(match[2]) if match[2] else None
    near, far = 0.0, math.inf
    if options["range_m"] is not None:
        match = re.fullmatch(r"([\d.]*):([\d.]*)", options["range_m"])
        try:
            near, far = float(match[1] or 0.0), float(match[2] or math.inf)  # type: ignore[index]  # TypeError
        except (TypeError, ValueError) as error:
            raise UserError(f"--range-m {options['range_m']}: write it as A:B, for example 2:20") from error
    if not options["mask_radius_m"] > 0.0:
        raise UserError(f"--mask-radius-m {options['mask_radius_m']}: must be positive")
    targets = None if options["mask"] is None else targets_of(options["mask"])
    return Stretch(pings, (near, far), targets, options["mask_radius_m"])


def _calibrated(
    graph: Graph, node: str, stretch: Stretch, options: dict[str, Any], *, shown: bool
) -> Calibration:
    from rich.progress import Progress

    from fls_flow.tools import calibrate as tool

    with Progress(console=screen(stderr=True), transient=True, disable=not shown) as bar:
        task = bar.add_task("pings", total=None)
        return tool.calibrate(
            graph,
            node,
            pfa=options["pfa"],
            per_beam=options["per_beam"],
            extrapolate=options["extrapolate"],
            stretch=stretch,
            curve=CURVE if options["plot"] is not None else (),
            on_ping=lambda done, total: bar.update(task, completed=done, total=total),
        )


def _document(found: Calibration) -> dict[str, Any]:
    return {
        "node": found.node,
        "kind": found.kind,
        "pings": found.pings,
        "pfa": found.point.pfa,
        "threshold_scale": found.threshold_scale,
        "scale_sd_of_log": found.scale_sd,
        "extrapolated": found.extrapolated,
        "now": found.now._asdict(),
        "before": found.point.before._asdict(),
        "after": found.point.after._asdict(),
        "curve": [
            {"pfa": point.pfa, "before": point.before._asdict(), "after": point.after._asdict()}
            for point in found.curve
        ],
    }


def _headline(found: Calibration) -> str:
    scale = found.point.scale
    said = f"{scale[0]:.4g}" if not found.per_beam else f"{scale.min():.4g} to {scale.max():.4g}, per beam"
    how = ", from a fitted tail" if found.extrapolated else ""
    within = 100.0 * math.expm1(2.0 * found.scale_sd)
    return (
        f"{found.node} ({found.kind}): threshold_scale {said} (within {within:.2g} %){how}\n"
        f"rates on the half of {found.pings} pings that the scale was not fitted to:"
    )


def _table(found: Calibration) -> Table:
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column()
    for name in ("wished", "measured", "95 % interval", "false alarms", "cells"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_row("as the graph is", "", *_cells(found.now))
    for name, one in (("scale 1", found.point.before), ("calibrated", found.point.after)):
        table.add_row(name, f"{found.point.pfa:g}", *_cells(one))
    return table


def _cells(one: Measured) -> tuple[str, ...]:
    return f"{one.rate:.3g}", f"{one.low:.2g} to {one.high:.2g}", f"{one.alarms:.0f}", f"{one.cells:,}"
