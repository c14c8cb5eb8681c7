"""The picture of `benchmarks.diver`: confusion of four classes, error over features and over SNR."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fls_flow.tools.train import Outcome
from fls_flow.tools.train_scores import Confusion


def both(one: Confusion, *, group: bool = False) -> tuple[int, int]:
    """Divers called something else and others called divers, and all."""
    (missed, divers), (called, others) = one.missed("diver", group=group), one.called("diver", group=group)
    return missed + called, divers + others


def draw(
    outcomes: dict[str, Outcome], curve: dict[str, list[tuple[float, float, float]]], path: Path
) -> None:
    """Confusion of the four classes, error over the number of features, error over SNR."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 3.6), layout="constrained")
    axes = figure.subplots(1, 4)
    for axis, (name, outcome) in zip(axes, outcomes.items(), strict=False):
        count, classes = outcome.plain.count, outcome.plain.classes
        part = count / count.sum(axis=1, keepdims=True)
        axis.imshow(part, cmap="Blues", vmin=0.0, vmax=1.0)
        for i, j in np.ndindex(*count.shape):
            axis.text(
                j, i, str(count[i, j]), ha="center", va="center", color="w" if part[i, j] > 0.5 else "k"
            )
        axis.set_xticks(range(len(classes)), classes)
        axis.set_yticks(range(len(classes)), classes)
        axis.set_title(f"{name}, held-out seeds")
        axis.set_xlabel("label")
        features = range(1, len(outcome.curve) + 1)
        error = [100 * both(one)[0] / both(one)[1] for one in outcome.curve]
        axes[2].plot(features, error, label=name)
    axes[2].set_yscale("symlog", linthresh=1.0)
    axes[2].set_xlabel("features")
    axes[2].set_ylabel("error, diver or not, %")
    axes[2].legend()
    for name, points in curve.items():
        axes[3].plot([p[0] for p in points], [100 * p[1] for p in points], "o-", label=f"{name}: error")
        axes[3].plot([p[0] for p in points], [100 * p[2] for p in points], ":", label=f"{name}: described")
    axes[3].set_xlabel("SNR of a gas scatterer, dB")
    axes[3].set_ylabel("%")
    axes[3].legend(fontsize=7)
    figure.savefig(path, dpi=90)
