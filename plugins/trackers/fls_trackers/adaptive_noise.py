"""Each track's own process and measurement noise, learnt from its innovations."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["NOISE_COLUMNS", "PROCESS", "SENSOR", "learn", "predict_each"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# Columns of the table (n, NOISE_COLUMNS) that goes with the tracks.
PROCESS, SENSOR = 0, 1  # log of the factors on Q and on R
INNOVATION = 2  # and 3: the last whitened innovation
KNOWN = 4  # whether the last ping gave one
NOISE_COLUMNS = 5

STEP = 0.05  # of a log factor per ping and unit of surprise
PROCESS_BOUNDS = (-math.log(4.0), math.log(64.0))
SENSOR_BOUNDS = (0.0, math.log(4.0))


@compiled
def predict_each(
    state: FloatArray, covariance: FloatArray, dt_s: float, velocity_walk_mps: float, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States and covariances after `dt_s` of nearly constant velocity, each track with its own noise.

    Q = q [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]] per axis, q = velocity_walk^2 / 1 s: white acceleration in
    continuous time, so that neither the ping rate nor a gap changes what is believed of the object.

    Source: Bar-Shalom & Li 1995, section 1.5.
    """
    x, P = state.copy(), np.empty_like(covariance)
    for t in range(x.shape[0]):
        q = velocity_walk_mps * velocity_walk_mps * math.exp(noise[t, PROCESS])
        for a in range(2):
            x[t, a] += dt_s * x[t, a + 2]
        _moved(covariance, dt_s, t, P)
        for a in range(2):
            P[t, a, a] += q * dt_s**3 / 3.0
            P[t, a, a + 2] += q * dt_s**2 / 2.0
            P[t, a + 2, a] += q * dt_s**2 / 2.0
            P[t, a + 2, a + 2] += q * dt_s
    return x, P


@compiled
def _moved(P: FloatArray, dt_s: float, t: int, result: FloatArray) -> None:
    """Sets result[t] to F P[t] F^T, F = [[1, dt], [0, 1]] per axis, symmetric to the bit."""
    for a in range(4):
        for b in range(a, 4):
            value = P[t, a, b]
            if a < 2:
                value += dt_s * P[t, a + 2, b]
            if b < 2:
                value += dt_s * (P[t, a, b + 2] + dt_s * P[t, a + 2, b + 2])
            result[t, a, b] = result[t, b, a] = value


@compiled
def learn(
    noise: FloatArray,
    state: FloatArray,
    covariance: FloatArray,
    R: FloatArray,
    y: FloatArray,
    event: IntArray,
) -> FloatArray:
    """The table after a ping in which track t had event[t] of `y` (m, 2) as its own, -1 for none.

    With w = S^(-1/2) (y - H x) of this ping and w' of the one before, which are uncorrelated and of unit
    variance when the filter is right: log q += STEP w.w' / 2, log r += STEP (w.w / 2 - 1). A process noise
    taken too small makes innovations repeat their sign, one too large makes them alternate; a noise of the
    sensor taken wrong makes them too long or too short.

    Source: the tests of Mehra 1970 for whiteness and size, as a stochastic approximation.
    """
    table = noise.copy()
    for t in range(table.shape[0]):
        row = table[t]
        if event[t] < 0:
            row[KNOWN] = 0.0
            continue
        s11, s12 = covariance[t, 0, 0] + R[t, 0, 0], covariance[t, 0, 1] + R[t, 0, 1]
        s22 = covariance[t, 1, 1] + R[t, 1, 1]
        l11 = math.sqrt(s11)
        l21 = s12 / l11
        l22 = math.sqrt(max(s22 - l21 * l21, 1e-300))
        w1 = (y[event[t], 0] - state[t, 0]) / l11
        w2 = (y[event[t], 1] - state[t, 1] - l21 * w1) / l22
        if row[KNOWN] > 0.0:
            repeat = 0.5 * (w1 * row[INNOVATION] + w2 * row[INNOVATION + 1])
            row[PROCESS] = _within(row[PROCESS] + STEP * repeat, PROCESS_BOUNDS)
        row[SENSOR] = _within(row[SENSOR] + STEP * (0.5 * (w1 * w1 + w2 * w2) - 1.0), SENSOR_BOUNDS)
        row[INNOVATION], row[INNOVATION + 1], row[KNOWN] = w1, w2, 1.0
    return table


@compiled
def _within(value: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1])
