"""Cut the excerpt of diver tracks out of the full table: every fifth frame, of boxes without gaps.

    python tests/golden/diver_motion/make.py FULL_TRACKS_CSV

The full table has a row per box: seq,width,height,nframes,frame,name,id,cx,cy,w,h; pixels, about 10 frames/s.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

EVERY = 5


def main(full: Path) -> None:
    """Write tracks.csv beside this script."""
    with full.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names: dict[tuple[str, str], int] = {}
    with (Path(__file__).parent / "tracks.csv").open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["diver", "frame", "cx", "cy", "w", "h"])
        for row in rows:
            diver = names.setdefault((row["seq"], row["name"]), len(names) + 1)
            if int(row["frame"]) % EVERY == 0:
                out.writerow(
                    [diver, row["frame"], *(f"{float(row[name]):g}" for name in ("cx", "cy", "w", "h"))]
                )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
