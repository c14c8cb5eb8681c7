"""Estimates from particles: a Gaussian mixture with as many components as targets are expected."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["centres", "fitted", "local_mass"]

FloatArray = npt.NDArray[np.float64]

BACKGROUND = 0.05  # part of the mass that no component needs to explain
ROUNDS = 12
STILL_M = 1e-3  # centres that move less have arrived
FAR = 18.0  # half of a squared distance beyond which a component does not count


def local_mass(position: FloatArray, weight: FloatArray, place: FloatArray, reach_m: float) -> FloatArray:
    """The weight of the particles (n, 2 or more) within `reach_m` of each place (k, 2)."""
    mass: FloatArray = _local_mass(position, weight, np.ascontiguousarray(place), reach_m)
    return mass


@compiled
def _local_mass(position: FloatArray, weight: FloatArray, place: FloatArray, reach_m: float) -> FloatArray:
    mass = np.zeros(place.shape[0])
    for k in range(place.shape[0]):
        for s in range(weight.size):
            dx, dy = position[s, 0] - place[k, 0], position[s, 1] - place[k, 1]
            if dx * dx + dy * dy <= reach_m * reach_m:
                mass[k] += weight[s]
    return mass


def centres(place: FloatArray, mass: FloatArray, n: int, reach_m: FloatArray) -> FloatArray:
    """Up to `n` of the places (k, 2), the one with the most mass first, each for one target.

    A chosen place is filled up to a mass of 1 by what lies within its reach (k,), nearest first: two
    measurements that share a target count once, and two targets near each other twice.
    """
    chosen: FloatArray = _centres(np.ascontiguousarray(place), mass, n, reach_m)
    return chosen


@compiled
def _centres(place: FloatArray, mass: FloatArray, n: int, reach_m: FloatArray) -> FloatArray:
    left = mass.copy()
    chosen = np.empty((min(n, mass.size), 2))
    k = 0
    while k < chosen.shape[0]:
        best = int(np.argmax(left))
        if not left[best] > 0.0:
            break
        chosen[k] = place[best]
        k += 1
        wanted = 1.0 - left[best]
        left[best] = 0.0
        apart = np.hypot(place[:, 0] - place[best, 0], place[:, 1] - place[best, 1])
        for j in np.argsort(apart, kind="mergesort"):
            if wanted <= 0.0 or apart[j] > reach_m[best]:
                break
            moved = min(wanted, left[j])
            left[j] -= moved
            wanted -= moved
    return chosen[:k].copy()


def fitted(
    state: FloatArray,
    weight: FloatArray,
    centre: FloatArray,
    start_sd_m: float,
    floor_sd_m: float,
    area_m2: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means (k, 4), covariances (k, 4, 4) and masses (k,) of the mixture that EM reaches from the centres.

    Responsibilities pi_k N(x, y; mu_k, S_k) over their sum and an even background (a twentieth of the mass
    over the area), which keeps particles that follow clutter from dragging components; mu, S and pi are
    weighted moments, S at least floor_sd^2 I. Velocities take the final responsibilities.

    Source: Clark & Bell 2005, step 3; EM of Dempster et al. 1977 with weights.
    """
    return _fitted(state, weight, centre, start_sd_m**2, floor_sd_m**2, BACKGROUND * weight.sum() / area_m2)


@compiled
def _fitted(
    state: FloatArray, weight: FloatArray, centre: FloatArray, start: float, floor: float, background: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    k = centre.shape[0]
    mean, spread, mass = np.zeros((k, 4)), np.zeros((k, 4, 4)), np.full(k, weight.sum() / max(k, 1))
    mean[:, :2] = centre
    for c in range(k):
        spread[c, 0, 0] = spread[c, 1, 1] = start
    moved = np.inf
    for number in range(ROUNDS + 1):
        last = number == ROUNDS or moved < STILL_M
        moved = _round(state, weight, mean, spread, mass, floor, background, 4 if last else 2)
        if last:
            break
    return mean, spread, mass


@compiled
def _round(
    state: FloatArray,
    weight: FloatArray,
    mean: FloatArray,
    spread: FloatArray,
    mass: FloatArray,
    floor: float,
    background: float,
    d: int,
) -> float:
    """One round of EM in place, moments over the first `d` of the state; gives how far a centre moved."""
    k = mass.size
    total, first, second = np.zeros(k), np.zeros((k, 4)), np.zeros((k, 4, 4))
    share = np.empty(k)
    inverse = _inverses(spread, mass)
    for s in range(weight.size):
        w = weight[s]
        if w == 0.0:
            continue
        norm = background
        for c in range(k):
            dx, dy = state[s, 0] - mean[c, 0], state[s, 1] - mean[c, 1]
            half = dx * (inverse[c, 0] * dx + inverse[c, 1] * dy) + dy * dy * inverse[c, 2]
            share[c] = inverse[c, 3] * math.exp(-half) if half < FAR else 0.0
            norm += share[c]
        for c in range(k):
            if share[c] > 0.0:
                part = w * share[c] / norm
                total[c] += part
                for a in range(d):
                    e = state[s, a] - mean[c, a]
                    first[c, a] += part * e
                    for o in range(a + 1):
                        second[c, a, o] += part * e * (state[s, o] - mean[c, o])
    return _moments(total, first, second, mean, spread, mass, floor, d)


@compiled
def _inverses(spread: FloatArray, mass: FloatArray) -> FloatArray:
    """Per component: half the inverse's (xx, 2 xy, yy), and mass over the normal's constant."""
    out = np.empty((mass.size, 4))
    for c in range(mass.size):
        a, b, e = spread[c, 0, 0], spread[c, 0, 1], spread[c, 1, 1]
        det = a * e - b * b
        out[c, 0], out[c, 1], out[c, 2] = 0.5 * e / det, -b / det, 0.5 * a / det
        out[c, 3] = mass[c] / (2.0 * math.pi * math.sqrt(det))
    return out


@compiled
def _moments(
    total: FloatArray,
    first: FloatArray,
    second: FloatArray,
    mean: FloatArray,
    spread: FloatArray,
    mass: FloatArray,
    floor: float,
    d: int,
) -> float:
    moved = 0.0
    for c in range(mass.size):
        mass[c] = total[c]
        if total[c] <= 0.0:
            continue
        for a in range(d):
            for o in range(a + 1):
                value = (second[c, a, o] - first[c, a] * first[c, o] / total[c]) / total[c]
                spread[c, a, o] = spread[c, o, a] = value
        moved = max(moved, math.hypot(first[c, 0], first[c, 1]) / total[c])
        for a in range(d):
            mean[c, a] += first[c, a] / total[c]
            spread[c, a, a] += floor
    return moved
