"""Images of a prepared scene: clutter, wakes and noise as power, echoes as field, gains, number format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_polar
from fls_sources.scene_clutter import (
    AmplitudeArray,
    Background,
    NumberFormat,
    beam_power,
    noise_gain,
    quantized,
    speckle,
)
from fls_sources.scene_motion import OwnShip, TimedPath, apparent
from fls_sources.scene_objects import Scatterers, SceneObject, echo_field
from fls_sources.scene_wake import Bubbles, wake_patch

__all__ = ["Sonar", "Stage"]

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sonar:
    """The geometry of the images: even range cells from `range_min_m` on, even beams around x."""

    range_min_m: float
    cell_m: float
    n_ranges: int
    beams_rad: FloatArray
    beam_spacing_rad: float
    beamwidth_rad: float
    side_lobe_db: float

    @property
    def range_m(self) -> FloatArray:
        """Centres of the range cells, m."""
        centre: FloatArray = self.range_min_m + (np.arange(self.n_ranges, dtype=float) + 0.5) * self.cell_m
        return centre

    @property
    def range_max_m(self) -> float:
        """The far border of the last cell, m."""
        return self.range_min_m + self.n_ranges * self.cell_m

    @property
    def half_width_rad(self) -> float:
        """Bearing of the outer border of the last beam, rad."""
        return float(self.beams_rad[-1]) + self.beam_spacing_rad / 2.0

    def sees(self, position_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Which positions (n, 2) of the sensor frame lie inside the sector."""
        distance, bearing = to_polar(position_m)
        inside = (distance >= self.range_min_m) & (distance < self.range_max_m)
        seen: npt.NDArray[np.bool_] = inside & (np.abs(bearing) <= self.half_width_rad)
        return seen


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene made ready: everything that is the same in all pings."""

    sonar: Sonar
    own: OwnShip
    things: tuple[SceneObject, ...]
    scatterers: Scatterers
    wakes: tuple[tuple[SceneObject, Bubbles], ...]
    water: Background
    number_format: NumberFormat

    def states(self, time_s: float) -> FloatArray:
        """Apparent states (n_things, 4) in the sensor frame."""
        return apparent(self.own, time_s, *self._motion(time_s))

    def ned_states(self, time_s: float) -> FloatArray:
        """States (n_things, 4) in the world, over ground."""
        return np.concatenate(self._motion(time_s), axis=1)

    def image(self, time_s: float, rng: np.random.Generator) -> AmplitudeArray:
        """The amplitudes (n_ranges, n_beams) of one ping."""
        intensity = speckle(self.water, self._extra_power(time_s), rng)
        self._add_echoes(intensity, time_s, rng)
        amplitude = np.sqrt(intensity, out=intensity)
        amplitude *= self.water.range_gain
        if self.water.law == "measured":
            amplitude *= self.water.beam_gain
        return quantized(amplitude, self.water.law, self.number_format)

    def _motion(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        states = [thing.path.at(time_s) for thing in self.things]
        position = np.array([p for p, _ in states]).reshape(-1, 2)
        return position, np.array([v for _, v in states]).reshape(-1, 2)

    def _extra_power(self, time_s: float) -> Float32Array | None:
        noisy = [(thing.path, thing.noise_db) for thing in self.things if thing.noise_db is not None]
        if not (noisy or self.wakes):
            return None
        sonar = self.sonar
        extra = np.zeros((sonar.n_ranges, sonar.beams_rad.size), np.float32)
        if self.wakes:
            rows, power = self._wake_power(time_s)
            extra[rows] += power
        for path, noise_db in noisy:
            extra += self._noise_power(path, noise_db, time_s)
        return extra

    def _wake_power(self, time_s: float) -> tuple[slice, FloatArray]:
        laid = [trail.alive(boat.path, time_s) for boat, trail in self.wakes]
        position = self.own.pose(time_s).to_sensor(np.concatenate([p for p, _ in laid]))
        sonar = self.sonar
        return wake_patch(
            *to_polar(position),
            np.concatenate([area for _, area in laid]),
            range_min_m=sonar.range_min_m,
            cell_m=sonar.cell_m,
            n_ranges=sonar.n_ranges,
            beams_rad=sonar.beams_rad,
            spacing_rad=sonar.beam_spacing_rad,
            beamwidth_rad=sonar.beamwidth_rad,
        )

    def _noise_power(self, path: TimedPath, noise_db: float, time_s: float) -> Float32Array:
        """Noise comes in by the beam pattern whatever the range, also from outside of the sector."""
        sonar = self.sonar
        position, _ = path.at(time_s)
        _, bearing = to_polar(self.own.pose(time_s).to_sensor(position))
        level = 10.0 ** (noise_db / 10.0) * noise_gain(sonar.range_m / sonar.range_max_m)
        beams = beam_power(sonar.beams_rad - float(bearing), sonar.beamwidth_rad, sonar.side_lobe_db)
        power: Float32Array = level.astype(np.float32)[:, None] * beams.astype(np.float32)
        return power

    def _add_echoes(self, intensity: Float32Array, time_s: float, rng: np.random.Generator) -> None:
        rows, field = self._echoes(time_s, rng)
        if rows.size == 0:
            return
        phase = rng.random(field.shape, dtype=np.float32) * np.float32(2.0 * np.pi)
        clutter = intensity[rows]
        beat = field.real * np.cos(phase) + field.imag * np.sin(phase)
        power = field.real**2 + field.imag**2
        # rounding may take |c + s|^2 of two opposite phasors a hair below zero
        intensity[rows] = np.maximum(clutter + power + 2.0 * np.sqrt(clutter) * beat, 0.0)

    def _echoes(self, time_s: float, rng: np.random.Generator) -> tuple[IntArray, npt.NDArray[np.complex64]]:
        """The echo field; a thing is brighter on its near side: exp(-2 depth / size) against its centre."""
        sonar, parts = self.sonar, self.scatterers
        position, velocity = self._motion(time_s)
        pose = self.own.pose(time_s)
        distance, bearing = to_polar(pose.to_sensor(parts.place(position, velocity)))
        centre, _ = to_polar(pose.to_sensor(position))
        depth = distance - centre[parts.owner]
        power = parts.power * np.exp(-2.0 * depth / np.maximum(parts.size_m, 1e-9) * (parts.size_m > 0.0))
        row = np.floor((distance - sonar.range_min_m) / sonar.cell_m).astype(np.int64)
        near = np.abs(bearing) < sonar.half_width_rad + 4.0 * sonar.beamwidth_rad
        seen = (row >= 0) & (row < sonar.n_ranges) & near
        return echo_field(
            row[seen],
            bearing[seen],
            power[seen],
            parts.coherence[seen],
            sonar.beams_rad,
            sonar.beamwidth_rad,
            sonar.side_lobe_db,
            rng,
        )
