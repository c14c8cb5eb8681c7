"""Cut the golden recordings out of the originals: python tests/golden/make.py SOURCE_DIR."""

from __future__ import annotations

import argparse
import io
import shutil
import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

HERE = Path(__file__).parent
FIRST, STOP = 70, 110  # two echoes are in view, apart, and move


def main() -> None:
    """Write the excerpts beside this script; SOURCE_DIR holds the folders didson and oculus."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="SOURCE_DIR", help="folder with didson/ and oculus/")
    source = parser.parse_args().source
    didson(source / "didson", HERE / "didson")
    oculus(source / "oculus", HERE / "oculus")


def didson(source: Path, target: Path) -> None:
    """Forty consecutive frames of lamprey1, with their frame numbers as `seq`."""
    target.mkdir(exist_ok=True)
    with np.load(source / "lamprey1_polar.npz", allow_pickle=False) as recording:
        excerpt = {key: recording[key] for key in ("bearing_rad", "range_rel", "fps")}
        excerpt["image"] = recording["image"][FIRST:STOP]
    excerpt["seq"] = np.arange(FIRST, STOP)
    write_npz(target / "lamprey1_40.npz", excerpt)
    shutil.copyfile(source / "LICENSE.md", target / "LICENSE.md")


def oculus(source: Path, target: Path) -> None:
    """The message streams as they are."""
    target.mkdir(exist_ok=True)
    for name in ("one_ping_8bit.raw", "three_pings_8bit.raw", "LICENSE"):
        shutil.copyfile(source / name, target / name)


def write_npz(path: Path, arrays: dict[str, npt.NDArray[np.generic]]) -> None:
    """Write a compressed npz without the time of writing, so that the bytes depend on the arrays alone."""
    with zipfile.ZipFile(path, "w") as archive:
        for key in sorted(arrays):
            npy = io.BytesIO()
            np.lib.format.write_array(npy, np.ascontiguousarray(arrays[key]).reshape(arrays[key].shape))
            entry = zipfile.ZipInfo(f"{key}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, npy.getvalue(), compresslevel=9)


if __name__ == "__main__":
    main()
