"""Labelled vectors, and model files made of them."""

from __future__ import annotations

import numpy as np
import pytest

from fls_flow import Features, Tracks
from fls_flow import model_files as files
from fls_flow.discriminants import fit

NAMES = ("area", "mean", "phi1")


@pytest.fixture
def rng():
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20261122)


@pytest.fixture
def labelled(rng):
    """Vectors (n, 3) of three classes with their own means, spreads and frequencies."""

    def made(counts=(60, 90, 40)):
        values, label = [], []
        for number, n in enumerate(counts):
            mixing = rng.normal(size=(3, 3)) + np.eye(3)
            values.append(rng.normal(size=(n, 3)) @ mixing.T + 2.0 * rng.normal(size=3))
            label += [number] * n
        return np.concatenate(values), np.array(label)

    return made


@pytest.fixture
def make_model(labelled):
    """A model of `diver`, `seal`, ... fitted to such vectors."""

    def made(counts=(60, 90), values=None, label=None, **options):
        if values is None:
            values, label = labelled(counts)
        names = ("diver", "seal", "fish")[: len(counts)]
        mean, scale = values.mean(axis=0), values.std(axis=0)
        found = fit((values - mean) / scale, label, len(counts))
        return files.Model(
            features=tuple(
                files.FeatureModel(name=name, unit="", mean=float(m), scale=float(s))
                for name, m, s in zip(options.pop("features", NAMES), mean, scale, strict=True)
            ),
            classes=tuple(
                files.ClassModel(
                    name=name,
                    prior=float(found.prior[n]),
                    samples=int(counts[n]),
                    mean=tuple(found.mean[n].tolist()),
                    covariance=tuple(tuple(row) for row in found.covariance[n].tolist()),
                )
                for n, name in enumerate(names)
            ),
            **{"ridge": 0.0, "positive": "diver", "miss_cost": 1.0, "false_alarm_cost": 1.0} | options,
        )

    return made


@pytest.fixture
def model_file(make_model, tmp_path):
    """The path of such a model."""

    def made(**options):
        path = tmp_path / "model.json"
        files.save(path, make_model(**options))
        return path

    return made


@pytest.fixture
def described():
    """Features of tracks: id -> vector."""

    def made(seq, rows, names=NAMES):
        values = np.array(list(rows.values()), float).reshape(len(rows), len(names))
        return Features(seq, 10 * seq, np.array(list(rows), np.int64), names, values)

    return made


@pytest.fixture
def alive():
    """Tracks of which only the ids matter."""

    def made(seq, ids):
        n = len(ids)
        ints = np.zeros(n, np.int64)
        return Tracks(
            seq, 10 * seq, np.array(ids, np.int64), np.ones(n, np.uint8), np.zeros((n, 4)), np.zeros((n, 4, 4)),
            ints, ints,
        )  # fmt: skip

    return made
