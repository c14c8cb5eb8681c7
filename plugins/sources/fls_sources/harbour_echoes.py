"""The scatterers of all swimmers and bubbles at one time, in the frame of the sonar."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fls_sources.harbour_plan import Planned, Visitor

__all__ = ["FADE_S", "echoes_at", "faced", "fade"]

FloatArray = npt.NDArray[np.float64]

FADE_S = 1.0  # in which a swimmer comes into the vertical beam, or leaves it
FACING_FLOOR = 0.15  # power of a part that is seen end-on, against broadside


def fade(visitor: Visitor, time_s: float) -> float:
    """Power of a swimmer that comes into the vertical beam or leaves it, from 0 to 1."""
    inside = (
        min(time_s - visitor.start_s, visitor.end_s - time_s)
        if visitor.start_s > 0.0
        else (visitor.end_s - time_s)
    )
    return float(np.clip(inside / FADE_S, 0.0, 1.0))


def faced(axis_rad: FloatArray, bearing_rad: FloatArray) -> FloatArray:
    """Power of parts by how they face the sonar: f + (1 - f) sin^2(axis - bearing); 1 where round (nan)."""
    across = np.sin(axis_rad - bearing_rad) ** 2
    return np.where(np.isnan(axis_rad), 1.0, FACING_FLOOR + (1.0 - FACING_FLOOR) * across)


def echoes_at(
    planned: Planned, time_s: float, current_mps: FloatArray, vertical_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 2) and mean powers (n,) of all scatterers; a body's own power is 1 per gas scatterer."""
    places, who = planned.present(time_s)
    position, power = [np.zeros((0, 2))], [np.zeros(0)]
    for place, state, w in zip(places.tolist(), planned.states(time_s, places), who.tolist(), strict=True):
        visitor = planned.visitors[w]
        seen = fade(visitor, time_s)
        where, strength = _body(visitor, state, time_s)
        position.append(where)
        power.append(seen * strength)
        puffs = visitor.puffs
        if puffs is not None:
            alive = puffs.alive(time_s)
            mouth = planned.ahead(place, puffs.release_s[alive], 0.45 * visitor.body.length_m)
            where, strength = puffs.at(time_s, mouth, current_mps, vertical_rad, alive)
            position.append(where)
            power.append(seen * strength)
    return np.concatenate(position), np.concatenate(power)


def _body(visitor: Visitor, state: FloatArray, time_s: float) -> tuple[FloatArray, FloatArray]:
    x, y, _, _, heading, turn_radps = state
    parts = visitor.body.echoes(time_s - visitor.start_s, float(turn_radps))
    c, s = np.cos(heading), np.sin(heading)
    ahead, starboard = parts.offset_m.T
    position = np.stack([x + c * ahead - s * starboard, y + s * ahead + c * starboard], axis=1)
    bearing = np.arctan2(position[:, 1], position[:, 0])
    return position, visitor.echo_gain * parts.power * faced(parts.axis_rad + heading, bearing)
