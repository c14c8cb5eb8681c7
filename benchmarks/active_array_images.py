"""Images of an active array with a target of several strengths, beamformed once.

Sound adds up: the echo of a steady target is simulated, compressed and shifted to baseband once, at 0 dB, and
added to the clutter with the amplitude that each signal-to-clutter ratio asks for. Beams are formed of the
whole window without the target, and again for each strength where its compressed pulse reaches, a pulse's
length around it. That gives the images of a simulation at that strength, to rounding
(`tests/graphs/test_active_array.py`), for a fraction of the time. The window is that of the target's path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fls_beamformers.delay_and_sum import DelayAndSum
from fls_beamformers.layout import Layout, Settings
from fls_beamformers.pulse_compression import PulseCompression
from fls_beamformers.steering import FineSamples, delay_and_sum, fine_samples
from fls_flow import HydrophoneBlock, Ping, Truth
from fls_sources.array_scene import ArrayScene

__all__ = ["Images", "Place", "scene"]

NEAR_M, FAR_M = 20.0, 180.0  # at most
BESIDE_M = 15.0  # of the path: more than the pulse and the reference cells reach
SCENE: dict[str, Any] = {
    "target_min_m": 80.0,
    "target_max_m": 120.0,
    "speed_min_mps": 0.2,
    "speed_max_mps": 0.5,
}
NO_TARGET_DB = -400.0
MARGIN_M = 1.0  # around the pulse: aperture, Doppler, interpolation


def scene(
    seed: int, correlation_pings: float, scr_db: float, pings: int, range_max_m: float = FAR_M
) -> ArrayScene:
    """One target, 80 to 120 m away at the first ping, 0.2 to 0.5 m/s."""
    return ArrayScene(
        pings=pings,
        seed=seed,
        scr_db=scr_db,
        clutter_correlation_pings=correlation_pings,
        range_max_m=range_max_m,
        **SCENE,
    )


@dataclass(frozen=True, eq=False)
class Place:
    """A ping without and with the target."""

    clutter: Ping
    rows: slice  # the only ones that the target changes
    images: list[Ping]  # for each strength
    truth: Truth


@dataclass
class Images:
    """The pings of one target's run, for all `scr_db` at once."""

    seed: int
    correlation_pings: float
    scr_db: Sequence[float]
    pings: int

    def __post_init__(self) -> None:
        self._compression = PulseCompression()
        path = scene(self.seed, self.correlation_pings, 0.0, self.pings)._states()[:, 0, :2]
        range_m = np.hypot(path[:, 0], path[:, 1])
        self.near_m = max(float(range_m.min()) - BESIDE_M, NEAR_M)
        self.far_m = min(float(range_m.max()) + BESIDE_M, FAR_M - 1.0)
        self._beams = DelayAndSum(range_min_m=self.near_m, range_max_m=self.far_m)
        self._layout: Layout | None = None

    def __iter__(self) -> Iterator[Place]:
        without, unit = (
            scene(self.seed, self.correlation_pings, scr_db, self.pings, self.far_m + 1.0)
            for scr_db in (NO_TARGET_DB, 0.0)
        )
        for (quiet, _), (loud, truth) in zip(without(), unit(), strict=True):
            echo = replace(loud, samples=loud.samples - quiet.samples)
            yield self._place(quiet, echo, truth, unit.pulse.duration_s)

    def _place(self, quiet: HydrophoneBlock, echo: HydrophoneBlock, truth: Truth, pulse_s: float) -> Place:
        block = self._compression(quiet)
        layout = self._layout = Layout.known(self._layout, Settings.of(self._beams), block)
        clutter, target = (
            fine_samples(*layout.baseband(one, self._beams.precision), layout.grid, layout.guard_s)
            for one in (block, self._compression(echo))
        )
        steering, count = layout.steering(clutter), layout.grid.count
        empty = delay_and_sum(clutter, steering, count)
        reach_m = 0.5 * layout.sound_speed_mps * pulse_s + MARGIN_M
        reach = np.array([-reach_m, reach_m])
        low, high = 0, 0  # the target may have left the window
        for place in truth.state[:, :2]:
            low, high = np.searchsorted(layout.range_m, np.hypot(*place) + reach).tolist()
        near = replace(steering, zone_start=np.clip(steering.zone_start, low, high))
        images = []
        for scr_db in self.scr_db:
            amplitude = empty.copy()
            both = _sum(clutter, target, 10.0 ** (scr_db / 20.0))
            amplitude[low:high] = delay_and_sum(both, near, count)[low:high]
            images.append(layout.ping(block, amplitude))
        return Place(layout.ping(block, empty), slice(low, high), images, truth)


def _sum(one: FineSamples, other: FineSamples, times: float) -> FineSamples:
    scale = one.real.dtype.type(times)
    return replace(one, real=one.real + scale * other.real, imag=one.imag + scale * other.imag)
