"""From the command to the first track, and from Ctrl-C to the end, of the demo as processes.

    python -m benchmarks.startup [--rounds 5]

Each round starts `fls-flow run surface_obstacle` anew; the first, which may compile, is not counted. Beside
it stands the bare start of Python with numpy, measured in the same rounds: compare ratios between machines.
"""

from __future__ import annotations

import argparse
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

RUN = [sys.executable, "-m", "fls_flow.cli", "run", "surface_obstacle", "--set", "sonar.pings=100000"]


def one_round() -> tuple[float, float]:
    """Seconds to the first track in tracks.csv, and from Ctrl-C to the exit."""
    with TemporaryDirectory() as place:
        out = Path(place) / "out"
        began = time.monotonic()
        process = subprocess.Popen(
            [*RUN, "--out", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        tracks = out / "tracks.csv"
        while not (tracks.is_file() and "tentative" in tracks.read_text()):
            if process.poll() is not None:
                raise SystemExit(f"the run ended with exit code {process.returncode}")
            time.sleep(0.01)
        first = time.monotonic() - began
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        stopping = time.monotonic()
        process.wait()
        return first, time.monotonic() - stopping


def bare_start() -> float:
    """Seconds that Python takes to import numpy."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", "import numpy"], check=True)
    return time.monotonic() - began


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    one_round()
    figures = [(*one_round(), bare_start()) for _ in range(rounds)]
    table = Table(title=f"seconds, {rounds} rounds")
    for name in ("", "min", "median", "max"):
        table.add_column(name, justify="right" if name else "left")
    names = ("command to first track", "Ctrl-C to exit", "python -c 'import numpy'")
    for name, values in zip(names, zip(*figures, strict=True), strict=True):
        table.add_row(name, *(f"{one(values):.2f}" for one in (min, statistics.median, max)))
    Console(width=90).print(table)


if __name__ == "__main__":
    main()
