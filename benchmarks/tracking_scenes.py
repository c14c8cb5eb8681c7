"""The scenes of `benchmarks/tracking.py`: targets that move straight, noise, false detections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import Detections, Truth, View
from fls_flow.geometry import to_polar

__all__ = ["PING_S", "P_D", "SCENES", "Scene", "Seen"]

FloatArray = npt.NDArray[np.float64]

PING_S = 0.5
RANGE_M = (1.0, 50.0)
RANGE_SD_M, BEARING_SD_RAD = 0.05, float(np.deg2rad(1.5))
P_D = 0.9


@dataclass(frozen=True)
class Seen:
    """One scan."""

    detections: Detections
    truth: Truth


@dataclass(frozen=True, eq=False)
class Scene:
    """Targets, (n, 4) as x, y (m), vx, vy (m/s) at the first scan, and what is seen of them."""

    name: str
    targets: FloatArray
    scans: int
    false_per_scan: float
    half_sector_rad: float

    @property
    def view(self) -> View:
        """What the sonar sees: beams of 1.5 deg, cells of 5 cm."""
        n = int(self.half_sector_rad / BEARING_SD_RAD)
        bearing = BEARING_SD_RAD * np.arange(-n, n + 1.0)
        return View(*RANGE_M, RANGE_SD_M, bearing, BEARING_SD_RAD)

    def draw(self, seed: int) -> list[Seen]:
        """The scans of one run."""
        rng = np.random.default_rng(seed)
        return [self._scan(rng, k) for k in range(self.scans)]

    def _scan(self, rng: np.random.Generator, k: int) -> Seen:
        state = self.targets.copy()
        state[:, :2] += PING_S * k * state[:, 2:]
        r, b = to_polar(state[rng.random(len(state)) < P_D, :2])
        r = r + RANGE_SD_M * rng.standard_normal(r.size)
        b = b + BEARING_SD_RAD * rng.standard_normal(b.size)
        n = int(rng.poisson(self.false_per_scan))
        far = np.sqrt(rng.uniform(RANGE_M[0] ** 2, RANGE_M[1] ** 2, n))  # even over the area
        aside = rng.uniform(-self.half_sector_rad, self.half_sector_rad, n)
        order = rng.permutation(r.size + n)
        stamp = round(k * PING_S * 1e9)
        detections = Detections(
            k,
            stamp,
            np.concatenate([r, far])[order],
            np.concatenate([b, aside])[order],
            np.ones(order.size),
            np.zeros((order.size, 2)),
            np.tile(np.diag([RANGE_SD_M**2, BEARING_SD_RAD**2]), (order.size, 1, 1)),
            np.zeros(order.size, np.uint8),
            self.view,
        )
        ids = np.arange(len(state))
        return Seen(detections, Truth(k, stamp, ids, state, ("target",) * len(state)))


def _polar(range_m: float, bearing_deg: float, vx: float, vy: float) -> list[float]:
    b = np.deg2rad(bearing_deg)
    return [range_m * float(np.cos(b)), range_m * float(np.sin(b)), vx, vy]


def _few() -> Scene:
    targets = [
        [15.0, 3.0, 0.05, 0.02],
        [22.0, -5.0, 0.1, 0.0],
        [30.0, 8.0, -0.05, -0.05],
        [36.0, -12.0, 0.0, 0.1],
        [44.0, 2.0, -0.1, 0.02],
    ]
    return Scene("5 targets, 10 false", np.array(targets), 300, 10.0, float(np.deg2rad(28.5)))


def _many() -> Scene:
    """Ten alone, three squares of four at 2.5 m that move as one, four pairs that cross halfway."""
    alone = [
        _polar(14.0, -50.0, 0.05, 0.0),
        _polar(44.0, -52.0, -0.05, 0.05),
        _polar(45.0, -30.0, -0.05, 0.0),
        _polar(12.0, 10.0, 0.0, 0.05),
        _polar(46.0, -8.0, 0.0, 0.05),
        _polar(46.0, 12.0, -0.05, 0.0),
        _polar(14.0, 48.0, 0.05, 0.05),
        _polar(45.0, 34.0, -0.05, 0.05),
        _polar(44.0, 54.0, -0.05, -0.05),
        _polar(9.0, -20.0, 0.0, 0.0),
    ]
    groups = [(24.0, -44.0, 0.05, 0.05), (20.0, 18.0, 0.05, 0.0), (28.0, 46.0, 0.0, -0.05)]
    corners = 1.25 * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    square = [
        [x + dx, y + dy, vx, vy]
        for x, y, vx, vy in (_polar(*group) for group in groups)
        for dx, dy in corners.tolist()
    ]
    half_s = 0.5 * 200 * PING_S
    meetings = [(34.0, -32.0), (30.0, -10.0), (36.0, 5.0), (36.0, 26.0)]
    ways = [(0.08, 0.08), (0.08, -0.08)]
    crossing = [
        [x - half_s * vx, y - half_s * vy, vx, vy]
        for x, y, _, _ in (_polar(r, b, 0.0, 0.0) for r, b in meetings)
        for vx, vy in ways
    ]
    targets = np.array([*alone, *square, *crossing])
    return Scene("30 targets, 50 false", targets, 200, 50.0, float(np.deg2rad(60.0)))


SCENES = {"few": _few(), "many": _many()}
