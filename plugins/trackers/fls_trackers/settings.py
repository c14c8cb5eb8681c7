"""The parameters of the multi-target trackers, as their presets and user give them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

from fls_flow import View
from fls_flow.messages import Frame
from fls_trackers.clutter import Clutter
from fls_trackers.track_bank import MAX_WINDOW

__all__ = [
    "PAPER",
    "POINTS",
    "RECOMMENDED",
    "Grain",
    "Hit",
    "Initiation",
    "Parameters",
    "Preset",
    "Settings",
    "grain_of",
    "settings_of",
]

Initiation = Literal["box", "gate"]
Hit = Literal["gated", "probable"]
Preset = Literal["recommended", "points", "paper"]

UNKNOWN_CELL_M = 0.05  # of a view that does not tell
UNKNOWN_SPACING_RAD = math.radians(1.5)
WIDE_SCENE_M = 100.0  # ranges beyond which Karoui doubles the box


@dataclass(frozen=True, slots=True)
class Settings:
    """Every parameter with its value; None where it follows from the view."""

    sigma_v_mps2: float = 0.03
    sigma_d_m: float | None = None
    sigma_delta_deg: float | None = None
    gamma: float = 9.0
    p_d: float = 0.9
    p_g: float | None = None  # None: 1 - exp(-gamma / 2)
    p_fa: float = 1e-6
    clutter: Clutter = "adaptive"
    initiation: Initiation = "gate"
    hit: Hit = "probable"
    m1: int = 8
    n1: int = 5
    start_score: float = 10.0
    m2: int = 20
    n2: int = 5  # a boat that crosses a wake is seen in fewer than half of the pings
    x_max_m: float | None = None
    y_max_m: float | None = None
    speed_sd_mps: float = 1.0
    max_sd_m: float = 20.0
    merge_pings: int = 10  # 0: off
    start_from_candidates: bool = False
    centroid_sd_m: float = 0.3  # least sigma_d_m when that follows from the view

    def __post_init__(self) -> None:
        _check_ranges(self)
        for m, n in (("m1", "n1"), ("m2", "n2")):
            window, needed = getattr(self, m), getattr(self, n)
            if not 1 <= needed <= window <= MAX_WINDOW:
                raise ValueError(f"{n} = {needed} of {m} = {window}: needs 1 <= {n} <= {m} <= {MAX_WINDOW}")

    @property
    def gate_probability(self) -> float:
        """p_g, or the probability that gamma gives two degrees of freedom."""
        return 1.0 - math.exp(-self.gamma / 2.0) if self.p_g is None else self.p_g

    def box_m(self, range_max_m: float) -> tuple[float, float]:
        """x_max and y_max: as set, or 5 m up to 100 m of range and 10 m beyond (Karoui 2015, section V)."""
        usual = 5.0 if range_max_m <= WIDE_SCENE_M else 10.0
        return (self.x_max_m or usual, self.y_max_m or usual)


def _check_ranges(s: Settings) -> None:
    positive = ("sigma_v_mps2", "sigma_d_m", "sigma_delta_deg", "gamma", "x_max_m", "y_max_m")
    for name in (*positive, "speed_sd_mps", "max_sd_m"):
        value = getattr(s, name)
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} = {value}: must be positive")
    if not s.start_score < math.inf:
        raise ValueError(f"start_score = {s.start_score}: must be a number, or -inf for no such test")
    for name in ("p_d", "p_fa"):
        if not 0.0 < getattr(s, name) < 1.0:
            raise ValueError(f"{name} = {getattr(s, name)}: must lie between 0 and 1")
    if s.p_g is not None and not 0.0 < s.p_g <= 1.0:
        raise ValueError(f"p_g = {s.p_g}: must be above 0 and at most 1")
    if s.merge_pings < 0:
        raise ValueError(f"merge_pings = {s.merge_pings}: must be 0 (off) or more")
    choices = {
        "clutter": ("adaptive", "cell", "paper"),
        "initiation": ("box", "gate"),
        "hit": ("gated", "probable"),
    }
    for name, allowed in choices.items():
        if getattr(s, name) not in allowed:
            raise ValueError(f"{name} = {getattr(s, name)!r}: must be one of {', '.join(allowed)}")


@dataclass
class Parameters:
    """What `jpda`, `pda` and `gnn` let users set; None is the preset's value. `Jpda` says what each means."""

    preset: Preset = "recommended"
    frame: Frame = "sensor"
    sigma_v_mps2: float | None = None
    sigma_d_m: float | None = None
    sigma_delta_deg: float | None = None
    gamma: float | None = None
    p_d: float | None = None
    p_g: float | None = None
    p_fa: float | None = None
    clutter: Clutter | None = None
    initiation: Initiation | None = None
    hit: Hit | None = None
    m1: int | None = None
    n1: int | None = None
    start_score: float | None = None
    m2: int | None = None
    n2: int | None = None
    x_max_m: float | None = None
    y_max_m: float | None = None
    speed_sd_mps: float | None = None
    max_sd_m: float | None = None
    merge_pings: int | None = None
    start_from_candidates: bool | None = None
    max_tracks: int = 500


RECOMMENDED = Settings()
POINTS = Settings(gamma=16.0, n1=4, start_score=13.0, speed_sd_mps=0.3, centroid_sd_m=0.0)
PAPER = Settings(
    sigma_v_mps2=1e-3,
    p_g=1.0,
    clutter="paper",
    initiation="box",
    hit="gated",
    m1=20,
    n1=16,
    n2=8,
    start_score=-math.inf,
    merge_pings=0,
    start_from_candidates=True,
    centroid_sd_m=0.0,
)


PRESETS: Mapping[str, Settings] = MappingProxyType(
    {"recommended": RECOMMENDED, "points": POINTS, "paper": PAPER}
)


def settings_of(preset: str, given: Mapping[str, Any]) -> Settings:
    """The settings of `preset` with the `given` ones in their place; m1 and n1 follow the way of initiation.

    Raises ValueError for an unknown preset or a value out of range.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset = {preset!r}: must be one of {', '.join(PRESETS)}")
    base = PRESETS[preset]
    usual = base
    if given.get("initiation", base.initiation) != base.initiation:
        usual = PAPER if given["initiation"] == "box" else RECOMMENDED
    return replace(base, **{"m1": usual.m1, "n1": usual.n1, **given})


@dataclass(frozen=True, slots=True)
class Grain:
    """What measurements of one view are like: their noise, cells and sector."""

    range_sd_m: float
    bearing_sd_rad: float
    cell_m: float
    spacing_rad: float
    area_m2: float


def grain_of(view: View, settings: Settings) -> Grain:
    """The grain of `view`; where the view does not tell, that of a 1.5 deg sonar with cells of 0.05 m.

    Unless set, sigma_d is the cell, but at least `centroid_sd_m`, and sigma_delta the beam spacing or the
    beamwidth, whichever is larger. The centre of a point echo is known better than that in bearing (0.3 of a
    beam in simulated scenes), but that of a boat or the end of a wake wanders over the object (up to 0.7 of a
    beam at 40 m), and a noise stated too small loses tracks, whereas one too large only slows them.
    """
    cell = view.cell_m if view.cell_m > 0.0 else UNKNOWN_CELL_M
    spacing = view.beam_spacing_rad if view.beam_spacing_rad > 0.0 else UNKNOWN_SPACING_RAD
    range_sd, bearing_sd = max(cell, settings.centroid_sd_m), spacing
    if view.beamwidth_rad > spacing:
        bearing_sd = view.beamwidth_rad
    if settings.sigma_d_m is not None:
        range_sd = float(settings.sigma_d_m)
    if settings.sigma_delta_deg is not None:
        bearing_sd = math.radians(settings.sigma_delta_deg)
    area = view.area_m2
    return Grain(range_sd, bearing_sd, cell, spacing, area if area > 0.0 else 0.0)
