"""Scenes by hand: files of few rows, and points without files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fls_flow.evaluate.scene import Points


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """A CSV file of a header and rows of text."""

    def one(name: str, header: str, *rows: str) -> Path:
        path = tmp_path / name
        path.write_text("\n".join([header, *rows]) + "\n")
        return path

    return one


@pytest.fixture
def points() -> Callable[..., Points]:
    """Points from (ping, owner, x, y), owners from 0; words and probabilities on demand."""

    def some(*rows: tuple[float, ...], word=None, probability=None, velocity=None, covariance=None) -> Points:
        table = np.array(sorted(rows), float).reshape(-1, 4)
        n = len(table)
        owner = table[:, 1].astype(np.int64)
        return Points(
            table[:, 0].astype(np.int64),
            owner,
            np.arange(owner.max() + 1 if n else 0),
            table[:, 2:],
            np.full((n, 2), np.nan) if velocity is None else np.asarray(velocity, float),
            np.full((n, 2, 2), np.nan) if covariance is None else np.asarray(covariance, float),
            np.full(n, "", np.str_) if word is None else np.asarray(word, np.str_),
            np.full(n, np.nan) if probability is None else np.asarray(probability, float),
        )

    return some


@pytest.fixture
def random_points(points: Callable[..., Points]) -> Callable[..., Points]:
    """Owners that live in a run of pings each and wander in a square of 20 m."""

    def some(rng: np.random.Generator, owners: int, pings: int) -> Points:
        rows: list[tuple[float, ...]] = []
        for owner in range(owners):
            first, last = np.sort(rng.integers(0, pings, 2))
            alive = [t for t in range(first, last + 1) if t in (first, last) or rng.random() < 0.8]
            rows += [(ping, owner, *rng.uniform(0, 20, 2)) for ping in alive]
        return points(*rows)

    return some
