"""Images of the sea floor from a sonar that looks down at it: speckle, echoes, shadows.

Sensor frame: x along the sonar's axis, y starboard, z down from it. The floor is a plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow import Mount
from fls_flow.geometry import rotation
from fls_sources.ground_scenarios import Floor, GroundObject
from fls_sources.ground_vehicle import Instant
from fls_sources.scene_clutter import LEVEL, AmplitudeArray, NumberFormat, beam_power, quantized
from fls_sources.scene_image import Sonar
from fls_sources.scene_objects import echo_field

__all__ = ["FloorImage", "Parts", "Sight", "parts_of"]

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

COLUMN_M = 0.2  # spacing of the columns that cast shadows
PARTS_PER_M = 40.0
MOST_PARTS = 800
NOISE = 3e-3  # power without floor or echo, against the floor on the beam's axis
SHADOW = 1e-2  # power of the floor in a shadow, of what it has outside
VERTICAL_LOBE_DB = -25.0
COHERENCE = 0.5


@dataclass(frozen=True, eq=False)
class Sight:
    """Where the sonar is and looks to, over the floor, at one instant."""

    R: FloatArray  # (3, 3) sensor to NED
    origin_m: FloatArray  # (3,) NED
    normal: FloatArray  # (3,) of the floor, in the sensor frame
    height_m: float  # along the normal

    @classmethod
    def of(cls, vehicle: Instant, mount: Mount, floor: Floor) -> Sight:
        """The sight from a sonar on `mount`."""
        R = vehicle.R @ rotation(mount.attitude_rad)
        origin = vehicle.position_m + vehicle.R @ np.array(mount.position_m)
        below = float(floor.depth_at(origin[0], origin[1])) - float(origin[2])
        return cls(R, origin, R.T @ floor.normal, below * float(floor.normal[2]))

    def polar(self, position_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Range (m), cone angle of the array and angle below the axis (rad) of NED positions (n, 3)."""
        m = (position_m - self.origin_m) @ self.R
        d = np.sqrt((m * m).sum(axis=-1))
        return d, np.arcsin(np.clip(m[..., 1] / d, -1.0, 1.0)), np.arctan2(m[..., 2], m[..., 0])

    def floor_below_axis(self, range_m: FloatArray, bearing_rad: FloatArray) -> FloatArray:
        """Angle below the axis (n_ranges, n_beams) at which beams meet the floor; nan where they do not.

        Of x A + z C = height - y B with x^2 + z^2 = (d cos(delta))^2: the angle of (A, C), less
        arccos(q / (d cos(delta) |(A, C)|)).
        """
        A, B, C = self.normal
        along, y = range_m[:, None] * np.cos(bearing_rad), range_m[:, None] * np.sin(bearing_rad)
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = (self.height_m - B * y) / (along * np.hypot(A, C))
            angle: FloatArray = np.arctan2(C, A) - np.arccos(reach)
        return angle

    def over_floor(self, position_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distance along the floor from the sonar's foot, and height over the floor, of NED positions."""
        m = (position_m - self.origin_m) @ self.R
        down = m @ self.normal
        level = m - down[..., None] * self.normal
        return np.sqrt((level * level).sum(axis=-1)), self.height_m - down


@dataclass(frozen=True, eq=False)
class Parts:
    """The scatterers and the shadow-casting columns of all things, NED."""

    position_m: FloatArray  # (n, 3) of scatterers
    glint: FloatArray  # (n,) share of its owner's power
    owner: IntArray  # (n,)
    column_m: FloatArray  # (k, 3) tops of columns


def parts_of(things: Sequence[GroundObject], floor: Floor, rng: np.random.Generator) -> Parts:
    """Scatterers spread evenly over each box, with exponential powers, and columns over its plan."""
    position, glint, owner, columns = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, np.int64)], []
    for k, thing in enumerate(things):
        n = int(np.clip(np.ceil(_extent_m(thing) * PARTS_PER_M), 1, MOST_PARTS))
        box = np.array([thing.length_m, thing.width_m, thing.height_m])
        offset = (rng.random((n, 3)) - np.array([0.5, 0.5, 0.0])) * box
        share = rng.standard_exponential(n)
        position.append(_placed(thing, floor, offset))
        glint.append(share / share.sum())
        owner.append(np.full(n, k, np.int64))
        if thing.height_m > 0.0:
            columns.append(_placed(thing, floor, _plan(box)))
    tops = np.concatenate(columns) if columns else np.zeros((0, 3))
    return Parts(np.concatenate(position), np.concatenate(glint), np.concatenate(owner), tops)


def _extent_m(thing: GroundObject) -> float:
    return float(np.sqrt(thing.length_m * thing.width_m))


def _plan(box: FloatArray) -> FloatArray:
    """Points over the top of a box, (k, 3)."""
    along, across = (
        np.linspace(-0.5, 0.5, int(np.ceil(side / COLUMN_M)) + 1) * side for side in (box[0], box[1])
    )
    a, b = np.meshgrid(along, across, indexing="ij")
    return np.stack([a.ravel(), b.ravel(), np.full(a.size, box[2])], axis=-1)


def _placed(thing: GroundObject, floor: Floor, offset_m: FloatArray) -> FloatArray:
    """NED positions of offsets ahead, to starboard of and above the foot of a thing."""
    c, s = np.cos(thing.heading_rad), np.sin(thing.heading_rad)
    north = thing.north_m + c * offset_m[:, 0] - s * offset_m[:, 1]
    east = thing.east_m + s * offset_m[:, 0] + c * offset_m[:, 1]
    return np.stack([north, east, floor.depth_at(north, east) - thing.above_m - offset_m[:, 2]], axis=-1)


@dataclass(frozen=True, eq=False)
class FloorImage:
    """What makes images: the sonar, the things, the number format."""

    sonar: Sonar
    vertical_beamwidth_rad: float
    things: tuple[GroundObject, ...]
    parts: Parts
    number_format: NumberFormat

    def image(self, sight: Sight, rng: np.random.Generator) -> AmplitudeArray:
        """The amplitudes (n_ranges, n_beams) of one ping."""
        horizon = self._horizon(sight)
        mean = self._floor_power(sight, horizon)
        intensity = rng.standard_exponential(mean.shape, dtype=np.float32) * mean.astype(np.float32)
        self._add_echoes(intensity, sight, horizon, rng)
        amplitude = np.sqrt(intensity) * np.float32(LEVEL[self.number_format])
        return quantized(amplitude, "rayleigh", self.number_format)

    def _horizon(self, sight: Sight) -> FloatArray:
        """Lowest (height - top) / distance of what stands nearer, (n_ranges, n_beams), inf without any."""
        sonar, tops = self.sonar, self.parts.column_m
        lowest = np.full((sonar.n_ranges + 1, sonar.beams_rad.size), np.inf)
        if len(tops):
            distance, top = sight.over_floor(tops)
            _, bearing, _ = sight.polar(tops)
            foot = np.sqrt(distance**2 + sight.height_m**2)  # slant range of the column's foot
            row = np.floor((foot - sonar.range_min_m) / sonar.cell_m).astype(np.int64) + 1
            beam = np.rint((bearing - sonar.beams_rad[0]) / sonar.beam_spacing_rad).astype(np.int64)
            seen = (row >= 1) & (row <= sonar.n_ranges) & (beam >= 0) & (beam < sonar.beams_rad.size)
            np.minimum.at(lowest, (row[seen], beam[seen]), ((sight.height_m - top) / distance)[seen])
        return np.minimum.accumulate(lowest, axis=0)[:-1]

    def _floor_power(self, sight: Sight, horizon: FloatArray) -> FloatArray:
        sonar = self.sonar
        angle = sight.floor_below_axis(sonar.range_m, sonar.beams_rad)
        seen = np.isfinite(angle)
        lobe = beam_power(np.where(seen, angle, 0.0), self.vertical_beamwidth_rad, VERTICAL_LOBE_DB)
        distance = np.sqrt(np.maximum(sonar.range_m**2 - sight.height_m**2, 1e-12))
        lit = np.where(horizon < (sight.height_m / distance)[:, None], SHADOW, 1.0)
        return np.where(seen, lobe * lit, 0.0) + NOISE

    def _add_echoes(
        self, intensity: Float32Array, sight: Sight, horizon: FloatArray, rng: np.random.Generator
    ) -> None:
        rows, field = self._echoes(sight, horizon, rng)
        if not rows.size:
            return
        phase = rng.random(field.shape, dtype=np.float32) * np.float32(2.0 * np.pi)
        clutter = intensity[rows]
        beat = field.real * np.cos(phase) + field.imag * np.sin(phase)
        power = field.real**2 + field.imag**2
        # rounding may take |c + s|^2 of two opposite phasors a hair below zero
        intensity[rows] = np.maximum(clutter + power + 2.0 * np.sqrt(clutter) * beat, 0.0)

    def _echoes(
        self, sight: Sight, horizon: FloatArray, rng: np.random.Generator
    ) -> tuple[IntArray, npt.NDArray[np.complex64]]:
        sonar, parts = self.sonar, self.parts
        d, bearing, below = sight.polar(parts.position_m)
        row = np.floor((d - sonar.range_min_m) / sonar.cell_m).astype(np.int64)
        near = np.abs(bearing) < sonar.half_width_rad + 4.0 * sonar.beamwidth_rad
        seen = (row >= 0) & (row < sonar.n_ranges) & near
        share = parts.glint * self._lit(sight, horizon, row, bearing)
        share /= np.bincount(parts.owner, share, minlength=len(self.things))[parts.owner]
        power = share * self._owner_power(d)
        power *= beam_power(below, self.vertical_beamwidth_rad, VERTICAL_LOBE_DB)
        return echo_field(
            row[seen],
            bearing[seen],
            power[seen],
            np.full(int(seen.sum()), COHERENCE),
            sonar.beams_rad,
            sonar.beamwidth_rad,
            sonar.side_lobe_db,
            rng,
        )

    def _owner_power(self, range_m: FloatArray) -> FloatArray:
        """Power of each scatterer's owner: its SNR in every cell that it fills."""
        extent = np.array([_extent_m(thing) for thing in self.things])[self.parts.owner]
        snr = np.array([10.0 ** (thing.snr_db / 10.0) for thing in self.things])[self.parts.owner]
        beams = np.maximum(1.0, extent / (range_m * self.sonar.beam_spacing_rad))
        power: FloatArray = snr * np.maximum(1.0, extent / self.sonar.cell_m) * beams
        return power

    def _lit(self, sight: Sight, horizon: FloatArray, row: IntArray, bearing: FloatArray) -> FloatArray:
        """1 for scatterers in sight, `SHADOW` behind what stands nearer, (n,)."""
        sonar = self.sonar
        distance, top = sight.over_floor(self.parts.position_m)
        foot = np.sqrt(distance**2 + sight.height_m**2)
        back = np.floor((foot - COLUMN_M - sonar.range_min_m) / sonar.cell_m).astype(np.int64)
        beam = np.rint((bearing - sonar.beams_rad[0]) / sonar.beam_spacing_rad).astype(np.int64)
        back, beam = np.clip(back, 0, sonar.n_ranges - 1), np.clip(beam, 0, sonar.beams_rad.size - 1)
        hidden = horizon[back, beam] < (sight.height_m - top) / np.maximum(distance, 1e-9) - 1e-9
        return np.where(hidden, SHADOW, 1.0)
