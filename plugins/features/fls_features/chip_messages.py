"""What flows between the feature nodes: chips cut out of pings, and the region of the object in each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import Sealed, array

__all__ = ["Chips", "Regions"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
AmplitudeArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Chips(Sealed):
    """Pieces of one ping around tracks, all of one size; cells without data are 0."""

    seq: int
    stamp_ns: int
    track_id: IntArray = array(np.int64, "n")
    amplitude: AmplitudeArray = array((np.float32, np.uint8, np.uint16), "n", "n_rows", "n_columns")
    origin: IntArray = array(np.int64, "n", 2)  # range cell and beam of each chip's first cell
    centre: IntArray = array(np.int64, "n", 2)  # the track's row and column in its chip
    range_m: FloatArray = array(float, "n", "n_rows")  # of each row's centre
    bearing_rad: FloatArray = array(float, "n", "n_columns")  # of each column
    cell_m: float = float("nan")  # spacing of the rows
    beam_spacing_rad: float = float("nan")  # median spacing of the ping's beams
    near_chip: IntArray = array(np.int64, "m")  # pairs of a chip and another confirmed track in or near it
    near_id: IntArray = array(np.int64, "m")  # that track
    near_polar: FloatArray = array(float, "m", 2)  # its range (m) and bearing (rad)
    course_rad: FloatArray = array(float, "n")  # where each track moves, from the sensor's x to starboard

    def __len__(self) -> int:
        return self.track_id.size


@dataclass(frozen=True, eq=False)
class Regions(Sealed):
    """The cells of each chip that belong to the object; in the order of the chips."""

    seq: int
    stamp_ns: int
    track_id: IntArray = array(np.int64, "n")
    mask: BoolArray = array(bool, "n", "n_rows", "n_columns")
    seed: IntArray = array(np.int64, "n", 2)  # row and column where the region began to grow
    kept: BoolArray = array(bool, "n")  # whether it describes an object: not empty, not leaked

    def __len__(self) -> int:
        return self.track_id.size
