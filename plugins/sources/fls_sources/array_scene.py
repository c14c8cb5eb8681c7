"""Simulate an active hydrophone array: a chirp's echoes from swimmers, reverberation, noise, the blast."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from math import isfinite
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import HydrophoneBlock, NavState, Truth, hookimpl
from fls_flow.geometry import turn
from fls_sources.array_echoes import Array, add_echoes, echo_delays_s
from fls_sources.array_field import ClutterField, beamformed_share
from fls_sources.array_geometry import FLOATER_M, positions_from_distances
from fls_sources.array_plan import Drift, Swimmers, apparent_states, drawn_starts, trajectories
from fls_sources.array_waveform import Chirp
from fls_sources.scene_motion import even_stamps

__all__ = ["ArrayPing", "ArrayScene"]

FloatArray = npt.NDArray[np.float64]
Place = tuple[float, float, float]
Fluctuation = Literal["steady", "swerling-1"]
START_STREAM, MOTION_STREAM, PING_STREAM = 0, 1, 2  # what the seed's random streams are for

log = logging.getLogger(__name__)


class ArrayPing(NamedTuple):
    """What a simulated array gives: what its hydrophones hear, and who is there."""

    block: HydrophoneBlock
    truth: Truth


@dataclass
class ArrayScene:
    """Hydrophone samples of an active array and the truth in them, the same for the same parameters.

    Targets are points at `targets` (rows of x, y, vx, vy at the first ping, NED) or, without, `n_targets`
    drawn by `seed`; they keep their velocity but for `acceleration_sd_mps2`, white between pings. Echoes
    have exact spherical delays and Doppler, from where the target is when the sound reaches it. Amplitudes
    are as after a gain over range that makes clutter even: `scr_db` is a target's peak power over the mean
    clutter power in a cell after pulse compression and beamforming (of steady targets; the mean of
    `swerling-1` ones, whose power is exponential and new at each ping), at every range.
    `scr_before_compression_db` says it per channel. The mean clutter power in a beam's cell is 1, averaged
    over bearings; that of noise lies `cnr_db` below it.

    Clutter is reverberation from infinitely many scatterers all around, in the array's plane: Rayleigh in
    every cell, with the coherence between hydrophones of waves from all directions, so that beams see a
    field and not channel noise. Its correlation between pings is exp(-1 / `clutter_correlation_pings`), 0
    none; it is fixed to the world, so that drift and yaw decorrelate it as they do between neighbouring
    pings. The direct blast peaks `blast_db` over the clutter. Not modelled: depth, refraction, multipath,
    bearing-dependent reverberation, echoes of earlier pings, self-noise that is correlated between channels,
    turning in a ping.

    `Truth` is in the sensor frame at the stamp, the start of transmission; a target is struck r / c later,
    at 2 r / c it is heard. It holds what lies within `range_max_m`. Ping `k` depends on the parameters and
    `k`. Positions from `distances_m` (n x n): the first hydrophone ahead, the second to starboard.

    Source: Abu et al. 2024, sections III and VI. Raises ValueError for bad parameters.
    """

    pings: int = 60
    n_targets: int = 1
    targets: tuple[tuple[float, float, float, float], ...] = ()
    target_min_m: float = 100.0
    target_max_m: float = 400.0
    speed_min_mps: float = 0.2
    speed_max_mps: float = 1.0
    acceleration_sd_mps2: float = 0.0
    fluctuation: Fluctuation = "steady"
    scr_db: float = 10.0
    cnr_db: float = 20.0
    clutter_correlation_pings: float = 0.0
    blast_db: float | None = 40.0
    drift_mps: tuple[float, float] = (0.0, 0.0)  # north, east
    yaw_deg: float = 0.0  # amplitude of the platform's swinging
    yaw_period_s: float = 60.0
    hydrophones_m: tuple[Place, ...] = FLOATER_M
    distances_m: tuple[tuple[float, ...], ...] = ()
    projector_m: Place = (0.0, 0.0, -0.4)
    pulse: Chirp = field(default_factory=Chirp)
    sample_rate_hz: float = 96e3
    range_max_m: float = 500.0
    sound_speed_mps: float = 1520.0
    ping_rate_hz: float = 1.0
    nav: bool = True  # whether blocks carry the platform's state
    seed: int = 0
    start_ns: int = 1_705_309_200_000_000_000  # 2024-01-15 09:00 UTC

    def __post_init__(self) -> None:
        for spec in fields(self):
            value = getattr(self, spec.name)
            self._require(spec.name, not isinstance(value, float) or isfinite(value), "finite")
        for name in ("range_max_m", "sound_speed_mps", "sample_rate_hz", "ping_rate_hz", "yaw_period_s"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        nought = ("n_targets", "target_min_m", "speed_min_mps", "acceleration_sd_mps2")
        for name in (*nought, "clutter_correlation_pings", "seed", "start_ns"):
            self._require(name, getattr(self, name) >= 0, "0 or more")
        self._require("pings", self.pings >= 1, "1 or more")
        self._require("target_max_m", self.target_max_m >= self.target_min_m, f"{self.target_min_m} or more")
        self._require(
            "speed_max_mps", self.speed_max_mps >= self.speed_min_mps, f"{self.speed_min_mps} or more"
        )
        known = get_args(Fluctuation)
        self._require("fluctuation", self.fluctuation in known, f"one of {known}")
        self._require_arrays()
        self._require_slow()
        nyquist = self.sample_rate_hz / 2.0
        if self.pulse.highest_hz >= nyquist:
            raise ValueError(
                f"pulse reaches {self.pulse.highest_hz} Hz; sample_rate_hz {self.sample_rate_hz} carries "
                f"less than {nyquist}"
            )

    def _require_arrays(self) -> None:
        for name in ("targets", "drift_mps", "hydrophones_m", "distances_m", "projector_m"):
            values = np.concatenate([np.ravel(one) for one in getattr(self, name)] or [np.zeros(0)])
            self._require(name, bool(np.isfinite(values).all()), "finite")
        self._require("hydrophones_m", len(self.hydrophones_m) >= 1, "one place or more")
        if self.distances_m:
            lengths = {len(row) for row in self.distances_m}
            self._require("distances_m", lengths == {len(self.distances_m)}, "square")
            positions_from_distances(self.distances_m)

    def _require_slow(self) -> None:
        """Times of reflection are found by iteration, which needs targets and platform slower than sound."""
        limit = self.sound_speed_mps / 10.0
        fastest = max([float(np.hypot(*one[2:])) for one in self.targets], default=0.0)
        own = float(np.hypot(*self.drift_mps))
        for name, speed in (("targets", fastest), ("speed_max_mps", self.speed_max_mps), ("drift_mps", own)):
            if speed > limit:
                raise ValueError(f"{name} reaches {speed} m/s; it must stay within a tenth of sound's")

    def __len__(self) -> int:
        return self.pings

    def __call__(self) -> Iterator[ArrayPing]:
        """Every ping with its truth, from the first, each time it is called."""
        array, clutter, drift = self._array, self._clutter(), self._drift
        states = self._states()
        position_m = array.hydrophone_m
        waveform = self.pulse.samples(self.sample_rate_hz)
        stamps = even_stamps(self.start_ns, self.pings, self.ping_rate_hz)
        log.info(
            "target power over clutter: %.1f dB in a cell, %.1f dB per channel before compression",
            self.scr_db,
            self.scr_before_compression_db,
        )
        for seq, stamp_ns in enumerate(stamps.tolist()):
            time_s = seq / self.ping_rate_hz
            samples = self._samples(clutter, states[seq], time_s, self._rng(PING_STREAM, seq))
            block = HydrophoneBlock(
                seq,
                stamp_ns,
                samples,
                self.sample_rate_hz,
                position_m,
                waveform,
                self.sound_speed_mps,
                nav=_nav(seq, stamp_ns, drift, time_s) if self.nav else None,
            )
            yield ArrayPing(block, self._truth(seq, stamp_ns, states[seq], time_s))

    @property
    def scr_before_compression_db(self) -> float:
        """A target's mean power during its echo over that of clutter, in a channel as it is heard."""
        pulse = self.pulse.samples(self.sample_rate_hz)
        echo = np.mean(np.square(pulse))
        return self.scr_db + 10.0 * float(np.log10(echo / self._clutter().sample_power))

    def _samples(
        self, clutter: ClutterField, state: FloatArray, time_s: float, rng: np.random.Generator
    ) -> npt.NDArray[np.float32]:
        array, pose = self._array, self._drift.pose(time_s)
        R = turn(pose.heading_rad)
        samples = clutter.next(array.hydrophone_m[:, :2] @ R.T + 2.0 * pose.origin_m, rng)
        samples += np.float32(self._noise_sd) * rng.standard_normal(samples.shape, np.float32)
        self._add_blast(samples)
        amplitude = np.full(len(state), 10.0 ** (self.scr_db / 20.0))
        if self.fluctuation == "swerling-1":
            amplitude *= np.sqrt(rng.standard_exponential(len(state)))
        flat = np.zeros((len(state), 1))
        position = np.concatenate([pose.to_sensor(state[:, :2]), flat], axis=1)
        velocity = np.concatenate([state[:, 2:] @ R, flat], axis=1)
        own = np.array([*(np.array(self.drift_mps) @ R), 0.0])
        first, last = (echo_delays_s(array, position, velocity, own, t) for t in (0.0, self.pulse.duration_s))
        add_echoes(samples, array, (first, last), amplitude)
        return samples

    def _add_blast(self, samples: npt.NDArray[np.float32]) -> None:
        if self.blast_db is None:
            return
        array = self._array
        path = np.linalg.norm(array.hydrophone_m - array.projector_m, axis=-1)[None] / self.sound_speed_mps
        add_echoes(samples, array, (path, path), np.array([10.0 ** (self.blast_db / 20.0)]))

    @cached_property
    def _array(self) -> Array:
        places = np.array(self.hydrophones_m, float)
        if self.distances_m:
            places = positions_from_distances(self.distances_m)
        n_samples = int(np.ceil(2.0 * self.range_max_m * self.sample_rate_hz / self.sound_speed_mps))
        projector = np.array(self.projector_m)
        return Array(places, projector, self.sound_speed_mps, self.sample_rate_hz, n_samples, self.pulse)

    def _clutter(self) -> ClutterField:
        tau = self.clutter_correlation_pings
        rho = float(np.exp(-1.0 / tau)) if tau > 0.0 else 0.0
        array, waveform = self._array, self.pulse.samples(self.sample_rate_hz)
        size = (array.n_samples, self.sound_speed_mps)
        field = ClutterField(waveform, self.sample_rate_hz, *size, 1.0, rho)
        share = beamformed_share(
            field.frequency_hz, field.filtered_power, array.hydrophone_m, self.sound_speed_mps
        )
        return ClutterField(waveform, self.sample_rate_hz, *size, 1.0 / share, rho)

    @cached_property
    def _noise_sd(self) -> float:
        """Per sample: a matched filter leaves 2 sd^2 / E of it, a beam of M channels 1 / M of that."""
        energy = float(np.sum(np.square(self.pulse.samples(self.sample_rate_hz))))
        n_channels = len(self._array.hydrophone_m)
        return float(np.sqrt(10.0 ** (-self.cnr_db / 10.0) * n_channels * energy / 2.0))

    @cached_property
    def _drift(self) -> Drift:
        return Drift(self.drift_mps, float(np.deg2rad(self.yaw_deg)), self.yaw_period_s)

    def _states(self) -> FloatArray:
        """NED states (pings, n, 4) of the targets."""
        start = np.array(self.targets, float).reshape(-1, 4)
        if not self.targets:
            limits = (self.target_min_m, self.target_max_m), (self.speed_min_mps, self.speed_max_mps)
            start = drawn_starts(Swimmers(self.n_targets, *limits), self._rng(START_STREAM))
        rng = self._rng(MOTION_STREAM)
        return trajectories(start, self.pings, 1.0 / self.ping_rate_hz, self.acceleration_sd_mps2, rng)

    def _truth(self, seq: int, stamp_ns: int, state: FloatArray, time_s: float) -> Truth:
        seen_as = apparent_states(state, self._drift, time_s)
        inside = np.flatnonzero(np.hypot(seen_as[:, 0], seen_as[:, 1]) <= self.range_max_m)
        return Truth(seq, stamp_ns, inside + 1, seen_as[inside], ("swimmer",) * inside.size)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *stream))

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")


def _nav(seq: int, stamp_ns: int, drift: Drift, time_s: float) -> NavState:
    pose = drift.pose(time_s)
    ahead, starboard = np.array(drift.velocity_mps) @ turn(pose.heading_rad)
    return NavState(
        seq,
        stamp_ns,
        position_m=(pose.north_m, pose.east_m, 0.0),
        attitude_rad=(0.0, 0.0, pose.heading_rad),
        attitude_rate_radps=(0.0, 0.0, drift.yaw_rate_radps(time_s)),
        velocity_mps=(float(ahead), float(starboard), 0.0),
    )


@hookimpl
def fls_node() -> type[ArrayScene]:
    """The simulated active array."""
    return ArrayScene
