"""The part of a recording that holds no target."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow.errors import UserError
from fls_flow.geometry import to_cartesian
from fls_flow.messages import Ping

__all__ = ["Stretch", "targets_of"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Stretch:
    """Which cells of which pings hold no target.

    `pings` counts from 0, its end excluded; None: all. Pings before it are played, so that what learns has
    learnt. `targets` gives the positions (n, 2) of known targets at a stamp, in the sensor frame; cells
    within `radius_m` of one are left out. So are cells outside `range_m`.
    """

    pings: tuple[int, int | None] | None = None
    range_m: tuple[float, float] = (0.0, math.inf)
    targets: Callable[[int], FloatArray] | None = None
    radius_m: float = 1.0

    def cleared(self, value: Any) -> Any:
        """A ping in which the cells that may hold a target are not valid; other messages as they are."""
        if not isinstance(value, Ping):
            return value
        near, far = self.range_m
        out = (value.range_m < near) | (value.range_m > far)
        masked = np.broadcast_to(out[:, None], value.amplitude.shape).copy()
        if self.targets is not None:
            places = to_cartesian(value.range_m[:, None], value.bearing_rad[None, :])
            for target in self.targets(value.stamp_ns):
                masked |= np.hypot(*np.moveaxis(places - target, -1, 0)) <= self.radius_m
        if not masked.any():
            return value
        valid = ~masked if value.valid is None else value.valid & ~masked
        return dataclasses.replace(value, valid=valid)


def targets_of(path: Path) -> Callable[[int], FloatArray]:
    """Where the tracks or the truth of a CSV file are at a stamp; raises UserError."""
    from fls_flow.evaluate.table import kind_of, read

    kind = kind_of(path)
    if kind not in ("tracks", "truth"):
        raise UserError(f"--mask {path}: holds {kind or 'no known columns'}; it takes tracks or truth")
    table = read(path, kind)
    if table.frame != "sensor":
        raise UserError(f"--mask {path}: positions are in the frame '{table.frame}'; it takes the sensor's")
    status = table.columns.get("status")
    known = np.ones(table.ping.size, bool) if status is None else status != "lost"
    place = np.stack([table.columns["x_m"], table.columns["y_m"]], axis=1)

    def at(stamp_ns: int) -> FloatArray:
        index = int(np.searchsorted(table.stamp_ns, stamp_ns))
        if index == table.stamp_ns.size or table.stamp_ns[index] != stamp_ns:
            return np.zeros((0, 2))
        found: FloatArray = place[(table.ping == index) & known]
        return found

    return at
