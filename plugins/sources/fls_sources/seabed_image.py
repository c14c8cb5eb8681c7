"""Images of a simulated sea-floor scene: speckle on sediments, echoes, acoustic shadows, number format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fls_flow.geometry import to_cartesian, to_polar
from fls_sources.scene_clutter import AmplitudeArray, Background, NumberFormat, quantized, speckle
from fls_sources.scene_image import Sonar
from fls_sources.scene_objects import Scatterers, SceneObject, echo_field
from fls_sources.seabed_floor import Floor
from fls_sources.seabed_plan import Vehicle, apparent

__all__ = ["SeabedStage", "shadowed"]

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

SHADOW_POWER = 0.1  # of the floor in a shadow: what side lobes and multipath leave


@dataclass(frozen=True, eq=False)
class SeabedStage:
    """A scene made ready: everything that is the same in all pings."""

    sonar: Sonar
    vehicle: Vehicle
    things: tuple[SceneObject, ...]
    scatterers: Scatterers
    floor: Floor
    water: Background
    number_format: NumberFormat
    altitude_m: float
    false_echoes: float  # expected number per ping
    false_snr_db: float

    def states(self, time_s: float) -> FloatArray:
        """Apparent states (n_things, 4) in the sensor frame."""
        return apparent(self.vehicle, time_s, *self._motion(time_s))

    def image(self, time_s: float, rng: np.random.Generator) -> AmplitudeArray:
        """The amplitudes (n_ranges, n_beams) of one ping."""
        sonar, pose = self.sonar, self.vehicle.pose(time_s)
        cells = to_cartesian(sonar.range_m[:, None], sonar.beams_rad[None, :])
        mean = self.floor.power(pose.to_ned(cells))
        mean *= self._shadows(time_s)
        intensity = speckle(self.water, None, rng)
        intensity *= mean.astype(np.float32)
        self._add(intensity, self._echoes(time_s, rng), rng)
        self._add(intensity, self._false(rng), rng)
        amplitude = np.sqrt(intensity) * self.water.range_gain
        return quantized(amplitude, self.water.law, self.number_format)

    def _motion(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        states = [thing.path.at(time_s) for thing in self.things]
        position = np.array([p for p, _ in states]).reshape(-1, 2)
        return position, np.array([v for _, v in states]).reshape(-1, 2)

    def _shadows(self, time_s: float) -> FloatArray:
        """Power factors (n_ranges, n_beams) behind what lies on the floor."""
        sonar = self.sonar
        lying = np.array([thing.class_name != "fish" for thing in self.things], bool)
        size = np.array([max(thing.width_m, thing.length_m) for thing in self.things])
        r, b = to_polar(self.states(time_s)[:, :2])
        return shadowed(sonar.range_m, sonar.beams_rad, r[lying], b[lying], size[lying], self.altitude_m)

    def _echoes(self, time_s: float, rng: np.random.Generator) -> tuple[IntArray, npt.NDArray[np.complex64]]:
        """The echo field; a thing is brighter on its near side, by exp(-2 depth / size)."""
        parts = self.scatterers
        position, velocity = self._motion(time_s)
        pose = self.vehicle.pose(time_s)
        distance, bearing = to_polar(pose.to_sensor(parts.place(position, velocity)))
        centre, _ = to_polar(pose.to_sensor(position))
        depth = distance - centre[parts.owner]
        power = parts.power * np.exp(-2.0 * depth / np.maximum(parts.size_m, 1e-9) * (parts.size_m > 0.0))
        return self._field(distance, bearing, power, parts.coherence, rng)

    def _false(self, rng: np.random.Generator) -> tuple[IntArray, npt.NDArray[np.complex64]]:
        """The field of echoes from nothing, even over range and bearing."""
        n, sonar = int(rng.poisson(self.false_echoes)), self.sonar
        r = rng.uniform(sonar.range_min_m, sonar.range_max_m, n)
        b = rng.uniform(-sonar.half_width_rad, sonar.half_width_rad, n)
        # several scatterers over half a metre, as of a stone
        spread = np.repeat(r, 8) + rng.uniform(-0.25, 0.25, 8 * n)
        power = np.full(8 * n, 10.0 ** (self.false_snr_db / 10.0))
        return self._field(spread, np.repeat(b, 8), power, np.full(8 * n, 0.5), rng)

    def _field(
        self,
        distance: FloatArray,
        bearing: FloatArray,
        power: FloatArray,
        coherence: FloatArray,
        rng: np.random.Generator,
    ) -> tuple[IntArray, npt.NDArray[np.complex64]]:
        sonar = self.sonar
        row = np.floor((distance - sonar.range_min_m) / sonar.cell_m).astype(np.int64)
        near = np.abs(bearing) < sonar.half_width_rad + 4.0 * sonar.beamwidth_rad
        seen = (row >= 0) & (row < sonar.n_ranges) & near
        return echo_field(
            row[seen],
            bearing[seen],
            power[seen],
            coherence[seen],
            sonar.beams_rad,
            sonar.beamwidth_rad,
            sonar.side_lobe_db,
            rng,
        )

    @staticmethod
    def _add(
        intensity: Float32Array,
        echo: tuple[IntArray, npt.NDArray[np.complex64]],
        rng: np.random.Generator,
    ) -> None:
        """|clutter + echo|^2 with a clutter phase that is even over the circle."""
        rows, field = echo
        if not rows.size:
            return
        phase = rng.random(field.shape, dtype=np.float32) * np.float32(2.0 * np.pi)
        clutter = intensity[rows]
        beat = field.real * np.cos(phase) + field.imag * np.sin(phase)
        power = field.real**2 + field.imag**2
        intensity[rows] = np.maximum(clutter + power + 2.0 * np.sqrt(clutter) * beat, 0.0)


def shadowed(
    range_m: FloatArray,
    beams_rad: FloatArray,
    r: FloatArray,
    bearing_rad: FloatArray,
    size_m: FloatArray,
    altitude_m: float,
) -> FloatArray:
    """Power factors (n_ranges, n_beams): `SHADOW_POWER` behind things at ranges `r` (n,), else 1.

    By similar triangles a thing of height h at range r hides the floor up to r a / (a - h), from a sonar at
    altitude a; without end when it is not lower than the sonar.
    """
    factor = np.ones((range_m.size, beams_rad.size))
    for distance, bearing, size in zip(r, bearing_rad, size_m, strict=True):
        end = distance * altitude_m / (altitude_m - size) if size < altitude_m else np.inf
        dark = (range_m > distance + 0.5 * size) & (range_m < end)
        hidden = np.abs(beams_rad - bearing) * distance < 0.5 * size
        factor[np.ix_(dark, hidden)] = SHADOW_POWER
    return factor
