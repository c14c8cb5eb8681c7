"""What the filters of the probability hypothesis density assume of targets, births, detection and clutter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from fls_flow.messages import Frame
from fls_trackers.life import Rules
from fls_trackers.track_bank import MAX_WINDOW

__all__ = ["Births", "PhdSettings"]

Births = Literal["far-end", "anywhere"]


@dataclass
class PhdSettings:
    """The parameters that all these filters share; probabilities and masses are per ping.

    `p_d` holds inside the sector and is 0 outside; a target that leaves the sector does not survive.
    `p_b` targets are born per ping, uniformly over the far end of the sector (as deep as `birth_depth_m`, by
    default one ping's way and three standard deviations of the range) or over all of it, with a velocity of
    (-`closing_mps`, 0) +- `speed_sd_mps`. Without `closing_mps` it is the vehicle's speed when navigation
    tells, else 0; in the frame `ned` targets stand still on average.
    `clutter_per_ping` false measurements are spread evenly over range and bearing; None: their number is
    learnt from the measurements that seem to be false.
    Without `sigma_range_m` and `sigma_bearing_deg` each detection's own covariance counts, and where it has
    none a cell (0.25 m at least) and a beam.

    In the frame `sensor` no navigation is needed. In `ned` own motion does not bend the targets' ways; a ping
    without position or heading is only predicted.

    An estimate joins the nearest track in its gate, else starts one; tracks are confirmed with n1 estimates
    in m1 pings, and lost with fewer than n2 in m2 or when less certain than `max_sd_m`.
    """

    frame: Frame = "sensor"
    p_d: float = 0.9
    p_s: float = 0.99
    p_b: float = 0.1
    births: Births = "far-end"
    birth_depth_m: float | None = None
    closing_mps: float | None = None
    speed_sd_mps: float = 0.5
    sigma_v_mps2: float = 0.1
    sigma_range_m: float | None = None
    sigma_bearing_deg: float | None = None
    clutter_per_ping: float | None = 2.0
    prior_targets: float = 1.0  # expected in the whole sector at the first ping
    m1: int = 3
    n1: int = 2
    m2: int = 3
    n2: int = 1
    max_sd_m: float = 5.0
    gamma: float = 16.0  # of the gate between tracks and estimates

    def __post_init__(self) -> None:
        if self.frame not in get_args(Frame):
            raise ValueError(f"frame = {self.frame!r}: must be one of {', '.join(get_args(Frame))}")
        if self.births not in get_args(Births):
            raise ValueError(f"births = {self.births!r}: must be one of {', '.join(get_args(Births))}")
        if not 0.0 < self.p_d < 1.0:
            raise ValueError(f"p_d = {self.p_d}: must lie between 0 and 1")
        if not 0.0 < self.p_s <= 1.0:
            raise ValueError(f"p_s = {self.p_s}: must be above 0 and at most 1")
        if self.closing_mps is not None and not math.isfinite(self.closing_mps):
            raise ValueError(f"closing_mps = {self.closing_mps}: must be finite")
        for name in ("p_b", "birth_depth_m", "sigma_range_m", "sigma_bearing_deg", "clutter_per_ping"):
            self._positive(name)
        for name in ("prior_targets", "speed_sd_mps", "sigma_v_mps2", "max_sd_m", "gamma"):
            self._positive(name)
        for m, n in (("m1", "n1"), ("m2", "n2")):
            window, needed = getattr(self, m), getattr(self, n)
            if not 1 <= needed <= window <= MAX_WINDOW:
                raise ValueError(f"{n} = {needed} of {m} = {window}: needs 1 <= {n} <= {m} <= {MAX_WINDOW}")

    @property
    def rules(self) -> Rules:
        """When tracks are confirmed and end."""
        return Rules(self.m1, self.n1, -math.inf, self.m2, self.n2, self.max_sd_m)

    def _positive(self, name: str) -> None:
        value = getattr(self, name)
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} = {value}: must be positive")
