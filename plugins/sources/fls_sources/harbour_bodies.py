"""Bodies as scatterers: where the parts of a diver, a seal, a dolphin or a school are, and how they echo.

Each body is a chain of parts in its own axes, ahead and to starboard of its centre. A scatterer echoes by its
material and by how its part faces the sonar: |sin(angle between part and line of sight)|^2 over a floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

__all__ = ["Diver", "Dolphin", "Echoes", "School", "Seal", "Swimmer"]

FloatArray = npt.NDArray[np.float64]

# mean echo power of a scatterer of each material, SPACING_M of a part; gas is 1
GAS, NEOPRENE, STEEL, BONE, TISSUE = 1.0, 0.4, 0.7, 0.15, 0.03
SPACING_M = 0.03  # of the scatterers along a part
SWIMBLADDER = 0.12  # of a fish as long as a hand


@dataclass(frozen=True, eq=False)
class Echoes:
    """n scatterers of one body in its own axes."""

    offset_m: FloatArray  # (n, 2): ahead and to starboard
    power: FloatArray  # (n,)
    axis_rad: FloatArray  # (n,) direction of the part they belong to, from ahead to starboard; nan: round


class Swimmer(Protocol):
    """A body that can be asked for its echoes."""

    length_m: float

    def echoes(self, age_s: float, turn_radps: float) -> Echoes:
        """The scatterers at some age of the swimmer, while it turns at this rate."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Scatterers between two joints, spread over a width."""

    along: FloatArray  # (n,) from 0 to 1
    across_m: FloatArray  # (n,)
    power: FloatArray

    @classmethod
    def of(cls, length_m: float, width_m: float, material: float, rng: np.random.Generator) -> _Part:
        n = max(2, int(np.ceil(length_m / SPACING_M)))
        glint = rng.standard_exponential(n)
        along = (np.arange(n) + rng.random(n)) / n
        return cls(along, width_m * (rng.random(n) - 0.5), material * glint / glint.mean())

    def between(self, a: tuple[float, float], b: tuple[float, float], gain: float = 1.0) -> Echoes:
        ax, bx = np.array(a), np.array(b)
        step = bx - ax
        length = max(float(np.hypot(*step)), 1e-9)
        normal = np.array([-step[1], step[0]]) / length
        offset = ax + self.along[:, None] * step + self.across_m[:, None] * normal
        axis = np.full(self.along.size, np.arctan2(step[1], step[0]))
        return Echoes(offset, gain * self.power, axis)


def _together(parts: list[Echoes]) -> Echoes:
    return Echoes(
        np.concatenate([p.offset_m for p in parts]),
        np.concatenate([p.power for p in parts]),
        np.concatenate([p.axis_rad for p in parts]),
    )


class Diver:
    """A swimmer in a neoprene suit with fins; tanks of steel, or counterlungs full of gas.

    Legs and fins kick with `kick_hz`: as a flutter, up and down, so that from the side only their length and
    the facing of the fins change; or as a frog, spreading and closing to both sides. Two or three kicks are
    followed by a glide. The length counts fins.
    """

    def __init__(self, length_m: float, tank: bool, rng: np.random.Generator) -> None:
        self.length_m = length_m
        s = length_m / 2.3
        self._s = s
        self._frog = bool(rng.random() < 0.35)
        self._kick_hz = float(rng.uniform(0.5, 0.8) if self._frog else rng.uniform(0.6, 1.1))
        self._phase = float(rng.uniform(0.0, 2.0 * np.pi))
        self._glide_period_s = float(rng.uniform(4.0, 9.0))
        self._head = _Part.of(0.3 * s, 0.2, NEOPRENE, rng)
        self._torso = _Part.of(0.65 * s, 0.4, NEOPRENE, rng)
        self._back = _Part.of(0.55 * s, 0.2, STEEL, rng) if tank else _Part.of(0.35 * s, 0.3, GAS, rng)
        self._arms = [_Part.of(0.5 * s, 0.1, 0.5 * NEOPRENE, rng) for _ in range(2)]
        self._legs = [_Part.of(0.85 * s, 0.14, NEOPRENE, rng) for _ in range(2)]
        self._fins = [_Part.of(0.5 * s, 0.2, 0.5 * NEOPRENE, rng) for _ in range(2)]

    def echoes(self, age_s: float, turn_radps: float) -> Echoes:
        """The scatterers at this age."""
        s = self._s
        stroke = 2.0 * np.pi * self._kick_hz * age_s + self._phase
        effort = np.clip(0.5 + 1.5 * np.sin(2.0 * np.pi * age_s / self._glide_period_s + self._phase), 0.1, 1)
        bend = float(np.clip(0.8 * turn_radps, -0.5, 0.5))  # the body follows its turn
        parts = [
            self._head.between((0.8 * s, 0.0), (1.1 * s, 0.15 * bend)),
            self._torso.between((0.15 * s, 0.0), (0.8 * s, 0.0)),
            self._back.between((0.2 * s, 0.0), (0.7 * s, 0.0)),
        ]
        for k, side in enumerate((-1.0, 1.0)):
            parts.append(self._arms[k].between((0.7 * s, 0.24 * side), (0.25 * s, 0.3 * side)))
            if self._frog:
                spread = 0.08 + 0.6 * float(effort) * max(np.sin(stroke), 0.0)
                reach, facing = 1.0 - 0.25 * float(effort) * max(np.cos(stroke), 0.0), 1.0
            else:
                pitch = 0.5 * float(effort) * np.sin(stroke + (np.pi if k else 0.0))
                spread, reach, facing = (
                    0.08,
                    float(np.cos(pitch)),
                    0.5 + 1.5 * float(np.sin(1.6 * pitch) ** 2),
                )
            angle = side * spread - bend
            hip = (0.15 * s, 0.12 * side)
            knee = (hip[0] - 0.85 * s * reach * np.cos(angle), hip[1] + 0.85 * s * reach * np.sin(angle))
            tip = (knee[0] - 0.5 * s * np.cos(0.7 * angle), knee[1] + 0.5 * s * np.sin(0.7 * angle))
            parts.append(self._legs[k].between(knee, hip))
            parts.append(self._fins[k].between(tip, knee, facing))
        return _together(parts)


class Seal:
    """A spindle of tissue around gas-filled lungs, its hind end beating from side to side.

    y(s) = A s^2 sin(2 pi f t - 2 s) over the hind half, s from the middle to the flippers; bouts of strokes
    alternate with glides.
    """

    def __init__(self, length_m: float, rng: np.random.Generator) -> None:
        self.length_m = length_m
        self._stroke_hz = float(rng.uniform(0.8, 1.4))
        self._phase = float(rng.uniform(0.0, 2.0 * np.pi))
        self._glide_period_s = float(rng.uniform(4.0, 10.0))
        self._skull = _Part.of(0.14 * length_m, 0.1 * length_m, BONE, rng)
        self._fore = _Part.of(0.45 * length_m, 0.26 * length_m, TISSUE, rng)
        self._lungs = _Part.of(0.28 * length_m, 0.16 * length_m, GAS, rng)
        n = 6
        self._hind = [
            _Part.of(0.5 * length_m / n, 0.2 * length_m * (1 - k / n), TISSUE, rng) for k in range(n)
        ]

    def echoes(self, age_s: float, turn_radps: float) -> Echoes:
        """The scatterers at this age."""
        L = self.length_m
        bend = float(np.clip(0.5 * turn_radps, -0.6, 0.6))
        effort = float(np.clip(2.0 * np.sin(2.0 * np.pi * age_s / self._glide_period_s + self._phase), 0, 1))
        s = np.linspace(0.0, 1.0, len(self._hind) + 1)
        wave = np.sin(2.0 * np.pi * self._stroke_hz * age_s + self._phase - 2.0 * s)
        y = L * s**2 * (0.15 * effort * wave - 0.2 * bend)
        x = -0.5 * L * s
        parts = [
            self._skull.between((0.36 * L, 0.05 * L * bend), (0.5 * L, 0.12 * L * bend)),
            self._fore.between((0.0, 0.0), (0.45 * L, 0.05 * L * bend)),
            self._lungs.between((0.02 * L, 0.0), (0.3 * L, 0.02 * L * bend)),
        ]
        for k, part in enumerate(self._hind):
            parts.append(part.between((x[k + 1], y[k + 1]), (x[k], y[k])))
        return _together(parts)


class Dolphin:
    """A spindle of tissue around large lungs, its tail beating up and down: the fluke's facing changes."""

    def __init__(self, length_m: float, rng: np.random.Generator) -> None:
        self.length_m = length_m
        self._stroke_hz = float(rng.uniform(0.8, 1.8))
        self._phase = float(rng.uniform(0.0, 2.0 * np.pi))
        self._skull = _Part.of(0.18 * length_m, 0.08 * length_m, BONE, rng)
        self._body = _Part.of(0.6 * length_m, 0.18 * length_m, TISSUE, rng)
        self._lungs = _Part.of(0.25 * length_m, 0.14 * length_m, GAS, rng)
        self._tail = _Part.of(0.3 * length_m, 0.06 * length_m, TISSUE, rng)
        self._fluke = _Part.of(0.2 * length_m, 0.08 * length_m, TISSUE, rng)

    def echoes(self, age_s: float, turn_radps: float) -> Echoes:
        """The scatterers at this age."""
        L = self.length_m
        bend = float(np.clip(0.3 * turn_radps, -0.4, 0.4))
        pitch = 0.5 * float(np.sin(2.0 * np.pi * self._stroke_hz * age_s + self._phase))
        root = (-0.2 * L, 0.0)
        end = (root[0] - 0.3 * L * np.cos(pitch) * np.cos(bend), -0.3 * L * np.sin(bend))
        return _together(
            [
                self._skull.between((0.32 * L, 0.0), (0.5 * L, 0.05 * L * bend)),
                self._body.between(root, (0.4 * L, 0.0)),
                self._lungs.between((0.02 * L, 0.0), (0.27 * L, 0.0)),
                self._tail.between(end, root),
                self._fluke.between((end[0], end[1] - 0.1 * L), (end[0], end[1] + 0.1 * L), 0.5 + abs(pitch)),
            ]
        )


class School:
    """Many fish, each a swimbladder, milling in an ellipse whose axes swell and shrink.

    Fish i is at a_i(t) (r_i cos(phi_i + w_i t), q(t) r_i sin(phi_i + w_i t)): circling at its own rate; the
    school stretches by a factor between its axes, slowly. The length is that of the whole school at rest.
    """

    def __init__(self, length_m: float, rng: np.random.Generator) -> None:
        self.length_m = length_m
        n = int(np.clip(12.0 * length_m**2, 20, 400) * rng.uniform(0.6, 1.4))
        self._radius = 0.5 * length_m * np.sqrt(rng.random(n))
        self._angle = 2.0 * np.pi * rng.random(n)
        self._rate = rng.normal(0.0, 0.15, n)
        self._power = SWIMBLADDER * rng.standard_exponential(n)
        self._period_s = rng.uniform(8.0, 30.0, 2)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        self._flatness = float(rng.uniform(0.45, 0.9))

    def echoes(self, age_s: float, turn_radps: float) -> Echoes:
        """The scatterers at this age."""
        slow = np.sin(2.0 * np.pi * age_s / self._period_s + self._phase)
        along, across = 1.0 + 0.25 * slow[0], self._flatness * (1.0 + 0.25 * slow[1])
        angle = self._angle + self._rate * age_s
        offset = np.stack([along * np.cos(angle), across * np.sin(angle)], axis=1) * self._radius[:, None]
        return Echoes(offset, self._power, np.full(offset.shape[0], np.nan))
