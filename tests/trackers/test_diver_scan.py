"""The scan of divers' tracks as a whole gives the bits of its steps, one after the other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal

from fls_flow import Detections, TrackStatus, View
from fls_flow.geometry import Pose
from fls_flow.kernels import frozen
from fls_trackers.clutter import cell_density
from fls_trackers.conversion import convert
from fls_trackers.diver_scan import diver_scan
from fls_trackers.diver_tracks import DiverTracks
from fls_trackers.echo_strength import strengths
from fls_trackers.encounters import Scan, encounters
from fls_trackers.fusion import fuse
from fls_trackers.grouping import grouped
from fls_trackers.initiation import by_place, strongest
from fls_trackers.nnkf import Nnkf
from fls_trackers.pdaf import Pdaf
from fls_trackers.single_target import follow, settle_by_score
from fls_trackers.track_bank import new_tracks

FloatArray = npt.NDArray[np.float64]
VIEW = View(1.0, 50.0, 0.05, np.deg2rad(np.arange(-28.5, 28.6, 1.5)), np.deg2rad(1.5))
SENSOR = (0.05, 0.026, 1.0, -2.0, 0.3)
DT_S, NEXT_ID = 0.25, 50

SETTINGS: list[dict[str, Any]] = [
    {},
    {"amplitude_sd": 0.5, "meeting_m": 4.0},
    {"group_m": 0.0, "resolution_m": 3.0},
    {"sharing": "own", "hit": "gated", "fusion": "covariance-intersection"},
    {"max_tracks": 12, "max_common_events": 1},
]


def pings(seed: int, scans: int) -> list[Detections]:
    """Four swimmers who come together, in clutter; some amplitudes are 0 or not known."""
    rng, found = np.random.default_rng(seed), []
    for k in range(scans):
        s = DT_S * k
        xy = np.array([[20.0, -3.0 + 0.4 * s], [20.0, 3.0 - 0.4 * s], [30.0, 1.0], [12.0 + 0.3 * s, 0.0]])
        xy = np.concatenate([xy + rng.normal(0.0, 0.3, xy.shape), rng.uniform([5, -8], [40, 8], (6, 2))])
        level = np.exp(rng.normal(0.0, 0.7, len(xy)))
        level[rng.integers(0, len(xy), 2)] = 0.0, np.nan
        seen = rng.random(len(xy)) < 0.9
        r, b = np.hypot(*xy.T)[seen], np.arctan2(xy[:, 1], xy[:, 0])[seen]
        n = r.size
        table, noise = np.zeros((n, 2)), np.zeros((n, 2, 2))
        kind = np.zeros(n, np.uint8)
        found.append(Detections(k, round(1e9 * s), r, b, level[seen], table, noise, kind, VIEW))
    return found


def engine_after(kind: type[Pdaf] | type[Nnkf], settings: dict[str, Any], scans: int) -> DiverTracks:
    """A tracker in the middle of its work: with tracks of all ages."""
    node = kind(p_d=0.9, **settings)
    for one in pings(3, scans):
        node(one)
    return node._tracker


def one_call(engine: DiverTracks, ping: Detections) -> tuple[Any, ...]:
    bank, level = engine._bank, ping.amplitude
    ln = frozen(strengths(level)) if engine._heard else level
    given = (bank.state, bank.covariance, bank.ledger, *engine._tables, ping.range_m, ping.bearing_rad)
    return diver_scan(*given, level, ln, NEXT_ID, DT_S, *SENSOR, 1e-4, 0.01, 0.05, 0.026, engine._fixed)


def step_by_step(engine: DiverTracks, ping: Detections) -> tuple[Any, ...]:
    bank, tables, f = engine._bank, engine._tables, engine._fixed[0]
    r, b, level = ping.range_m, ping.bearing_rad, ping.amplitude
    if f["group_m"] > 0.0:
        r, b, group = grouped(r, b, level, f["group_m"])
        most = np.full(r.size, -np.inf)
        np.maximum.at(most, group, np.nan_to_num(level, nan=-np.inf))
        level = most
    ln = strengths(level) if engine._heard else np.full(r.size, np.nan)
    y, R0 = convert(r, b, SENSOR[0], SENSOR[1], Pose(*SENSOR[2:]))
    R0 += float(f["extent_sd_m"]) ** 2 * np.eye(2)
    x, P, rows, noise, strength, event, none, known, claimed = follow(
        bank.state,
        bank.covariance,
        bank.ledger,
        tables.noise,
        tables.strength,
        y,
        ln,
        cell_density(r, 1e-4, 0.05, 0.026, 0.01),
        (DT_S, float(f["velocity_walk_mps"])),
        SENSOR,
        tuple(float(f[name]) for name in ("extent_sd_m", "amplitude_sd", "resolution_m")),
        tuple(float(f[name]) for name in ("gamma", "factor", "miss")),
        tuple(bool(f[name]) for name in ("one_event", "only_probable", "estimate_noise", "joint")),
    )
    confirm = (int(f["m1"]), int(f["n1"]), float(f["start_score"]))
    limits = (int(f["max_propagate"]), float(f["max_sd_m"]), int(f["max_common_events"]), bool(f["joint"]))
    rows, keep, part = settle_by_score(rows, x, P, event, none, confirm, *limits)
    for t in np.flatnonzero(part >= 0):
        fuse(x, P, int(part[t]), int(t), bool(f["by_intersection"]))
    meeting = tables.meeting
    if f["meeting_m"] > 0.0:
        status = np.where(keep, rows["status"], TrackStatus.LOST)
        seen = Scan(rows["id"].copy(), status, x, P, strength, event, ln)
        walk = (DT_S, float(f["velocity_walk_mps"]))
        meeting, path = encounters(meeting, seen, walk, float(f["meeting_m"]), float(f["amplitude_sd"]))
        x, P, noise, strength = x[path], P[path], noise[path], strength[path]
    free, room = ~known, int(f["max_tracks"]) - int(np.count_nonzero(keep))
    if np.count_nonzero(free) > room:
        best = strongest(np.flatnonzero(free), level, max(room, 0))
        free = np.isin(np.arange(free.size), best)
    which = by_place(free, r, b)
    started = new_tracks(y, R0, (float(f["speed_sd_mps"]),) * 2, 0, which)
    started.ledger["id"] = NEXT_ID + np.arange(len(started))
    lost = rows["status"] == TrackStatus.LOST
    shown, n = keep | lost, which.size
    heard = np.isfinite(ln[which])
    begun = np.stack([np.where(heard, ln[which], 0.0), heard.astype(float)], axis=1)
    more = (started.state, started.covariance, started.ledger, np.zeros((n, noise.shape[1])), begun)
    tables_after = (x, P, rows, noise, strength, meeting)
    joined = [
        np.concatenate([one[shown], new])
        for one, new in zip(tables_after, (*more, np.zeros((n, meeting.shape[1]))), strict=True)
    ]
    return (*joined, np.count_nonzero(lost), n, np.count_nonzero(~claimed), True)


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda one: "-".join(one) or "usual")
@pytest.mark.parametrize("kind", [Pdaf, Nnkf])
@pytest.mark.parametrize("scans", [0, 3, 40])
def test_a_scan_is_its_steps(kind: type[Pdaf] | type[Nnkf], settings: dict[str, Any], scans: int) -> None:
    engine = engine_after(kind, settings, scans)
    for ping in (pings(9, 1)[0], pings(9, 1)[0].select(np.zeros(0, int)), pings(3, scans + 1)[-1]):
        for got, expected in zip(one_call(engine, ping), step_by_step(engine, ping), strict=True):
            assert_array_equal(got, expected)


def test_a_scan_writes_none_of_its_inputs() -> None:
    engine = engine_after(Pdaf, {"amplitude_sd": 0.5, "meeting_m": 4.0}, 40)
    held = (engine._bank.state, engine._bank.covariance, engine._bank.ledger, *engine._tables)
    before = [one.copy() for one in held]
    after = one_call(engine, pings(3, 41)[-1])
    for was, now, new in zip(before, held, after, strict=False):
        assert_array_equal(was, now)
        assert not np.shares_memory(now, new)


def test_what_is_not_finite_leaves_everything() -> None:
    engine, ping = engine_after(Nnkf, {}, 10), pings(3, 11)[-1]
    bad = replace(ping, range_m=np.where(np.arange(len(ping)) == 1, np.inf, ping.range_m))
    assert one_call(engine, bad)[-1] is False


@pytest.mark.parametrize("settings", [{"meeting_m": 4.0}, {}])
def test_the_strength_of_echoes_is_heard_only_where_it_matters(settings: dict[str, Any]) -> None:
    """A single event per track asks nobody how strong it is; amplitudes then change nothing."""
    quiet, loud = Nnkf(group_m=0.0, **settings), Nnkf(group_m=0.0, **settings)
    for one in pings(5, 60):
        a, b = quiet(replace(one, amplitude=np.ones(len(one)))), loud(one)
        assert_array_equal(a.id, b.id)
        assert_array_equal(a.state, b.state)
