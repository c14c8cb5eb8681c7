"""How well `nav-ukf` places two targets from a manoeuvring vehicle, against the raw measurements.

    python -m benchmarks.ground_accuracy [--runs 100]

Per measurement noise and variant: tracks lost, rms position error from ping 20 on (sensor frame), its ratio
to that of the measurements, and the mean NEES (2 is consistent). Navigation has the errors of `ground-nav`.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from fls_flow import Detections, TrackStatus
from fls_sources.ground_nav import GroundNav
from fls_sources.ground_scene import GroundScene, GroundView
from fls_trackers.nav_fusion import NavFusion
from fls_trackers.nav_ukf import NavUkf

Scene = list[tuple[GroundView, Detections]]
FloatArray = npt.NDArray[np.float64]

VARIANTS: dict[str, dict[str, Any]] = {
    "adaptive, exact": {},
    "adaptive, euler": {"step": "euler"},
    "huber, exact": {"noise": "huber"},
    "paper, exact": {"noise": "paper"},
    "paper, euler": {"noise": "paper", "step": "euler"},
    "fixed at 1 m, exact": {"noise": "fixed"},
    "adaptive, no navigation": {"blind": True},
}
DRAWS = 4  # of the errors of navigation
SETTLED = 20


def scenes() -> list[Scene]:
    """True detections with navigation joined to them, for some draws of its errors."""
    views = list(GroundScene(mode="points", range_sd_m=0.0, bearing_sd_deg=0.0)())
    return [list(joined(views, GroundNav(seed=seed))) for seed in range(DRAWS)]


def joined(views: list[GroundView], nav: GroundNav) -> Iterator[tuple[GroundView, Detections]]:
    """Each view with its detections after `nav-fusion`."""
    fusion, stream, last = NavFusion(), iter(nav()), -1
    for view in views:
        samples = []
        while last < view.ping.stamp_ns:
            samples.append(next(stream).nav_state)
            last = samples[-1].stamp_ns
        yield view, fusion(view.ping, tuple(samples), (), view.detections).detections


def one_run(
    scene: Scene, seed: int, range_sd_m: float, variant: dict[str, Any]
) -> tuple[int, FloatArray, FloatArray, FloatArray]:
    """Tracks lost, squared errors of tracks and of measurements, and NEES, once settled."""
    rng, chosen = np.random.default_rng(seed), dict(variant)
    blind = chosen.pop("blind", False)
    tracker, lost = NavUkf(frame="sensor", **chosen), 0
    errors, raw, nees = [], [], []
    for view, exact in scene:
        n = len(exact)
        found = replace(
            exact,
            range_m=exact.range_m + range_sd_m * rng.standard_normal(n),
            bearing_rad=exact.bearing_rad + np.deg2rad(1.5) * rng.standard_normal(n),
            view=replace(exact.view, nav=None) if blind else exact.view,
        )
        tracks, truth = tracker(found).tracks, view.truth.state[:, :2]
        lost += int((tracks.status == TrackStatus.LOST).sum())
        if view.ping.seq < SETTLED or not len(tracks):
            continue
        apart = tracks.state[None, :, :2] - truth[:, None]
        nearest = (apart**2).sum(axis=-1).argmin(axis=1)
        e, P = apart[np.arange(len(truth)), nearest], tracks.covariance[nearest, :2, :2]
        errors.append((e**2).sum(axis=-1))
        raw.append(((found.position_m - truth) ** 2).sum(axis=-1))
        nees.append(np.einsum("na,nab,nb->n", e, np.linalg.inv(P), e))
    return lost, np.array(errors), np.array(raw), np.array(nees)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=100)
    runs = parser.parse_args().runs
    logging.disable(logging.WARNING)  # the blind trackers say that they are
    prepared = scenes()
    table = Table(title=f"two targets, {runs} runs")
    for column in ("noise, m", "variant", "lost", "measured, m", "tracked, m", "better by", "NEES"):
        table.add_column(column, justify="left" if column == "variant" else "right")
    for range_sd_m in (0.5, 1.0, 2.0):
        for name, variant in VARIANTS.items():
            every = [one_run(prepared[k % DRAWS], k, range_sd_m, variant) for k in range(runs)]
            lost = sum(one[0] for one in every)
            tracked, measured = (float(np.sqrt(np.mean([one[i] for one in every]))) for i in (1, 2))
            nees = float(np.mean([one[3] for one in every]))
            figures = (f"{measured:.2f}", f"{tracked:.2f}", f"{measured / tracked:.1f}", f"{nees:.2f}")
            table.add_row(f"{range_sd_m:g}", name, str(lost), *figures)
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
