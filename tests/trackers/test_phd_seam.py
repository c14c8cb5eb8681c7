"""PHD filters on sectors that lie astern or go all round: bearings count on, there is no seam at 180 degrees."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fls_flow import Detections, View
from fls_flow.geometry import wrap
from fls_trackers.gm_cphd import GmCphd
from fls_trackers.gm_phd import GmPhd
from fls_trackers.particle_phd import ParticlePhd
from fls_trackers.phd_sector import sector_of

FILTERS = [
    lambda: GmPhd(births="anywhere"),
    lambda: GmPhd(births="anywhere", recursion="phd"),
    lambda: GmCphd(births="anywhere"),
    lambda: ParticlePhd(births="anywhere", particles=400, birth_particles=200),
    lambda: ParticlePhd(births="anywhere", particles=400, birth_particles=200, recursion="phd"),
]
NAMES = ["gm", "gm-phd", "cphd", "particles", "particles-phd"]


def scan(number: int, range_m: Any, bearing_rad: Any, table: Any) -> Detections:
    n = np.size(range_m)
    return Detections(
        number,
        10**9 + number * 500_000_000,
        np.asarray(range_m, float),
        np.asarray(bearing_rad, float),
        np.ones(n),
        np.zeros((n, 2)),
        np.broadcast_to(np.diag([0.1**2, np.radians(1.0) ** 2]), (n, 2, 2)),
        np.zeros(n, np.uint8),
        View(5.0, 60.0, 0.1, np.asarray(table, float), np.radians(1.0)),
    )


@pytest.mark.parametrize("make", FILTERS, ids=NAMES)
def test_a_target_that_passes_astern_of_an_array_stays_one_track(make: Any) -> None:
    """It crosses 180 degrees, and the half beams beyond the first and the last of 360, in small steps."""
    node, table = make(), np.radians(np.arange(-179, 181))
    identities: list[tuple[int, ...]] = []
    for number in range(24):
        bearing = np.radians(177.0 + 0.25 * number)
        tracks = node(scan(number, [25.0], wrap(np.array([bearing])), table))[0]
        identities.append(tuple(tracks.id[tracks.status == 1].tolist()))
    assert identities[4:] == [identities[4]] * 20
    assert len(identities[4]) == 1


@pytest.mark.parametrize("make", FILTERS, ids=NAMES)
@pytest.mark.parametrize("turned_rad", [np.pi, -np.pi + 0.1, 2.0])
@pytest.mark.parametrize("wrapped", [True, False], ids=["wrapped table", "counting on"])
def test_a_sonar_that_looks_astern_tracks_as_one_that_looks_ahead(
    make: Any, turned_rad: float, wrapped: bool
) -> None:
    ahead, astern, table = make(), make(), np.linspace(-0.4, 0.4, 41)
    turn = wrap if wrapped else np.asarray
    for number in range(15):
        where = np.array([-0.05 + 0.01 * number, 0.2])
        distance = np.array([20.0 + 0.1 * number, 40.0])
        one = ahead(scan(number, distance, where, table))[0]
        other = astern(scan(number, distance, turn(where + turned_rad), turn(table + turned_rad)))[0]
    assert len(one) == len(other) == 2
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    turned = one.state[:, :2] @ np.array([[c, s], [-s, c]])
    assert np.abs(turned - other.state[:, :2]).max() < 0.3


def test_sectors_of_tables_that_jump_or_close_the_circle() -> None:
    table = np.linspace(np.pi - 0.3, np.pi + 0.3, 31)
    sector = sector_of(scan(0, [], [], wrap(table)).view)
    assert sector is not None
    assert sector.width_rad == pytest.approx(0.62)
    for degrees in (np.arange(-179, 181), np.arange(-180, 181), np.arange(0, 360)):
        whole = sector_of(scan(0, [], [], np.radians(degrees)).view)
        assert whole is not None
        assert whole.width_rad == pytest.approx(2.0 * np.pi)
        angle = np.linspace(-np.pi, np.pi, 1001)
        assert whole.holds(np.stack([20.0 * np.cos(angle), 20.0 * np.sin(angle)], axis=1)).all()
