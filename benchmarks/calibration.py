"""Wished against measured false-alarm rates of four detectors on real recordings, before and after.

    python -m benchmarks.calibration [RECORDING ...] [--out rates.png] [--pfa 1e-4]

By default on the recordings among the tests. A recording is an npz file for `polar-npz`, an Oculus stream
(.raw), or an npz file that holds nothing but images, whose geometry is then made up: 10 m, 120 degrees. In
recordings of 30 pings or more the moving targets are found by the chain of the graph `surface_on_recording`
and masked with 0.6 m around each; everything else, walls and bottom included, counts as clutter. Detectors:
Rayleigh, ordered-statistic and log-domain CFAR on the samples as they are, and, where there are pings enough
to learn from, the Rayleigh CFAR behind a clutter map. The first pings, in which it learns, are left out.
Scales are found on the first half of the other pings (of a few pings: on every other twentieth of the beams)
and the rates shown are those of the other half.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run
from fls_flow.tools import calibrate_picture
from fls_flow.tools.calibrate import Calibration, calibrate
from fls_flow.tools.calibrate_stretch import Stretch, targets_of
from fls_sources.oculus_raw import OculusRaw

ROOT = Path(__file__).parents[1]
GRAPH = ROOT / "graphs" / "surface_on_recording.yaml"
WARM_UP = 10
LONG = 30  # pings
RATES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)

RAW = """
graph: raw
nodes:
  sonar: SOURCE
  cfar:  {use: KIND, in: {ping: sonar}, with: {guard_m: 0.4, reference_m: 1.0}}
  csv:   {use: detection-csv, in: {detections: cfar}, with: {path: detections.csv}}
"""
STILL = """
graph: still
nodes:
  sonar: SOURCE
  still: {use: clutter-map, in: {ping: sonar}, with: {warm_up_pings: 8, floor: 3.0}}
  cfar:  {use: rayleigh-cfar, in: {ping: still}, with: {guard_m: 0.4, reference_m: 1.0, floor: 0.7}}
  csv:   {use: detection-csv, in: {detections: cfar}, with: {path: detections.csv}}
"""
DETECTORS = {
    "rayleigh-cfar": RAW.replace("KIND", "rayleigh-cfar"),
    "os-cfar": RAW.replace("KIND", "os-cfar"),
    "log-cfar": RAW.replace("KIND", "log-cfar"),
    "clutter-map, rayleigh-cfar": STILL,
}


@dataclass(frozen=True)
class Source:
    """How a recording is played."""

    name: str
    text: str
    pings: int
    whole: Path | None  # for the chain that finds what moves


def source_of(recording: Path, folder: Path) -> Source:
    """How to play a recording; one without geometry is written anew, with one."""
    if recording.suffix == ".raw":
        text = f"{{use: oculus-raw, with: {{path: '{recording}'}}}}"
        return Source(recording.stem, text, len(OculusRaw(recording)), None)
    tables = np.load(recording)
    path, image = recording, tables["image"]
    if "bearing_rad" not in tables:
        image = image if image.ndim == 3 else image[None]
        path = folder / recording.name
        _, n_ranges, n_beams = image.shape
        bearing = np.deg2rad(np.linspace(-60.0, 60.0, n_beams))
        np.savez(
            path, image=image, bearing_rad=bearing, range_rel=np.arange(1, n_ranges + 1) / n_ranges, fps=10.0
        )
    text = f"{{use: polar-npz, with: {{path: '{path}', range_max_m: 10.0}}}}"
    return Source(recording.stem, text, len(image), path if len(image) >= LONG else None)


def found_tracks(recording: Path, folder: Path) -> Path:
    """The tracks of what moves in a recording."""
    graph = graphs.load(GRAPH, set_=[f"sonar.path={recording}", "picture.pings=[]"])
    report = Run(graph, Options(in_order=True), out=folder).start()
    if report.error is not None:
        raise report.error
    return folder / "tracks.csv"


def calibrated(recording: Path, pfa: float) -> tuple[Source, dict[str, Calibration]]:
    """What calibration finds for each detector."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        source = source_of(recording, folder)
        stretch = Stretch()
        if source.whole is not None:
            targets = targets_of(found_tracks(source.whole, folder))
            stretch = Stretch(pings=(WARM_UP, None), targets=targets, radius_m=0.6)
        found = {}
        for title, text in DETECTORS.items():
            if source.whole is None and text is STILL:
                continue
            file = folder / "graph.yaml"
            file.write_text(text.replace("SOURCE", source.text), encoding="utf-8")
            found[title] = calibrate(
                graphs.load(file), pfa=pfa, extrapolate=True, stretch=stretch, curve=RATES
            )
        return source, found


def main() -> None:
    """Print a table per recording, and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pfa", type=float, default=1e-4)
    options = parser.parse_args()
    golden = ROOT / "tests" / "golden"
    default = [golden / "didson" / "lamprey1_40.npz", golden / "oculus" / "three_pings_8bit.raw"]
    panels: list[tuple[str, Calibration] | None] = []
    for recording in options.recordings or default:
        source, found = calibrated(recording.absolute(), options.pfa)
        title = (
            f"{source.name}, {source.pings} pings: false alarms per cell, wished {options.pfa:g}, held out"
        )
        table = Table(title=title)
        for column in ("detector", "threshold_scale 1", "calibrated (95 %)", "threshold_scale"):
            table.add_column(column)
        for title, one in found.items():
            panels.append((f"{source.name}: {title}", one))
            before, after = one.point.before, one.point.after
            interval = f"{after.rate:.2e} ({after.low:.1e} to {after.high:.1e})"
            table.add_row(title, f"{before.rate:.2e}", interval, f"{one.threshold_scale:.3g}")
        panels += [None] * (-len(panels) % len(DETECTORS))
        Console(width=110).print(table)
    if options.out is not None:
        calibrate_picture.draw(panels, options.out, columns=len(DETECTORS))


if __name__ == "__main__":
    main()
