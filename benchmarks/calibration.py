"""Wished against measured false-alarm rates of four detectors on real recordings, before and after calibration.

    python benchmarks/calibration.py [RECORDING.npz ...] [--out rates.png] [--pfa 1e-4]

By default on the DIDSON recording among the tests. Its moving targets are found by the chain of the graph
`surface_on_recording` and masked with 0.6 m around each; everything else, walls and bottom included, counts as
clutter. Detectors: Rayleigh, ordered-statistic and log-domain CFAR on the samples as they are, and
the Rayleigh CFAR behind a clutter map. The first pings, in which the clutter map learns, are left out. Scales are
found on the first half of the other pings and the rates shown are those of the second half.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

from fls_flow import graph as graphs
from fls_flow.runtime import Options, Run
from fls_flow.tools import calibrate_picture
from fls_flow.tools.calibrate import Calibration, Stretch, calibrate, targets_of

ROOT = Path(__file__).parents[1]
GRAPH = ROOT / "graphs" / "surface_on_recording.yaml"
WARM_UP = 10
RATES = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)

RAW = """
graph: raw
nodes:
  sonar: {use: polar-npz, with: {path: recording.npz, range_max_m: 10.0}}
  cfar:  {use: KIND, in: {ping: sonar}, with: {guard_m: 0.4, reference_m: 1.0}}
  csv:   {use: detection-csv, in: {detections: cfar}, with: {path: detections.csv}}
"""
STILL = """
graph: still
nodes:
  sonar: {use: polar-npz, with: {path: recording.npz, range_max_m: 10.0}}
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


def found_tracks(recording: Path, folder: Path) -> Path:
    """The tracks of what moves in a recording."""
    graph = graphs.load(GRAPH, set_=[f"sonar.path={recording}", "picture.pings=[]"])
    report = Run(graph, Options(in_order=True), out=folder).start()
    if report.error is not None:
        raise report.error
    return folder / "tracks.csv"


def calibrated(recording: Path, pfa: float) -> dict[str, Calibration]:
    """What calibration finds for each detector."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        targets = targets_of(found_tracks(recording, folder))
        stretch = Stretch(pings=(WARM_UP, None), targets=targets, radius_m=0.6)
        found = {}
        for title, text in DETECTORS.items():
            file = folder / "graph.yaml"
            file.write_text(text, encoding="utf-8")
            graph = graphs.load(file, set_=[f"sonar.path={recording}"])
            found[title] = calibrate(graph, pfa=pfa, stretch=stretch, curve=RATES)
        return found


def main() -> None:
    """Print a table per recording, and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pfa", type=float, default=1e-4)
    options = parser.parse_args()
    recordings = options.recordings or [ROOT / "tests" / "golden" / "didson" / "lamprey1_40.npz"]
    panels = []
    for recording in recordings:
        table = Table(title=f"{recording.name}: false alarms per cell, wished {options.pfa:g}, second half")
        for column in ("detector", "threshold_scale 1", "calibrated (95 %)", "threshold_scale"):
            table.add_column(column)
        for title, one in calibrated(recording.absolute(), options.pfa).items():
            panels.append((f"{recording.stem}: {title}", one))
            before, after = one.point.before, one.point.after
            interval = f"{after.rate:.2e} ({after.low:.1e} to {after.high:.1e})"
            table.add_row(title, f"{before.rate:.2e}", interval, f"{one.threshold_scale:.3g}")
        Console(width=110).print(table)
    if options.out is not None:
        calibrate_picture.draw(panels, options.out, columns=len(DETECTORS))


if __name__ == "__main__":
    main()
