"""Divers against marine life on simulated harbours held out by seed, and so by track.

    python -m benchmarks.diver                    # all; some ten minutes of one core
    python -m benchmarks.diver --only held-out --picture docs/divers.png
    python -m benchmarks.diver --only held-out --test 3101 3116      # judged on other seeds

Scenes come from `graphs/diver_training.yaml`: another seed is another background with other swimmers.
Features come from the tracks that the chain made, not from the truth; the truth only names them. What the
models take from the features (how many, which) is chosen by cross-validation inside the training scenes.
Intervals are Clopper & Pearson's at 95 %, as if vectors were independent; those of one target are not, so
targets, each by its most frequent label, are counted too. "As the graph decides" are the labels that the
classifier of `graphs/diver_classification.yaml`, with its parameters and the model just trained, gives to
tracks in the pings that describe them, one after the other: the evidence of a track's earlier blocks counts.
"Withheld" are blocks without a label, though their track was described often enough: its descriptions do not
agree. Such a track may be anything, a diver too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from benchmarks.diver_figure import both, draw
from benchmarks.diver_labels import GATE_M, decided, labelling
from fls_flow.discriminants import decide, linear, posterior
from fls_flow.model_files import Model, save
from fls_flow.testing import run_graph
from fls_flow.tools.train import Outcome, Settings, lessons, train
from fls_flow.tools.train_samples import Labelling, Samples, gather
from fls_flow.tools.train_scores import Confusion, confusion, interval
from fls_flow.tools.train_tables import find_runs

GRAPH = "diver_training"
MISS_COST = 100.0
TRAIN, TEST = range(1, 37), range(3001, 3017)
FAINT = {14.0: range(49, 61), 11.0: range(61, 73)}  # SNR, dB, of more scenes to train on
FEW_TRAIN, FEW_TEST = range(1, 9), range(3001, 3005)
SNRS_DB = (20.0, 14.0, 11.0, 8.0, 5.0, 2.0)
GOAL = {"static": 1.18, "temporal": 0.0}
MOTION = ("speed_mps", "axis_on_course", "axis_on_sight", "course_on_sight")
WAYS: dict[str, dict[str, Any]] = {
    "labels": {},
    "nothing withheld": {"agreement": 1},
    "from the first block on": {"agreement": 1, "min_descriptions": 1},
    "newest block alone": {"agreement": 1, "min_descriptions": 1, "memory": 0.0, "handover": 0.0},
}
MARINE = (("marine-life", ("seal", "dolphin", "fish")),)
Sets = dict[str, Samples]
Rule = Literal["linear", "quadratic"]
RULE: Rule = "linear"


@dataclass(frozen=True)
class Scenes:
    """Where scenes are kept, and how many pings they have."""

    folder: Path
    pings: int
    test: range = TEST

    def play(self, seeds: Iterable[int], name: str = "plain", settings: Sequence[str] = ()) -> list[Path]:
        """The folders of the scenes with these seeds and settings; those that are there are not run again."""
        folders = []
        for seed in seeds:
            out = self.folder / name / str(seed)
            if not (out / "done").exists():
                out.mkdir(parents=True, exist_ok=True)
                given = [f"sonar.seed={seed}", f"sonar.pings={self.pings}", *settings]
                run_graph(GRAPH, set_=given, out=out)
                (out / "done").touch()
            folders.append(out)
        return folders

    def at_snr(self, seeds: Iterable[int], snr_db: float) -> list[Path]:
        """The folders of the scenes with these seeds at another SNR."""
        return self.play(seeds, f"snr-{snr_db:g}", [f"sonar.snr_db={snr_db}"])


def samples(runs: list[Path], groups: tuple[tuple[str, tuple[str, ...]], ...] = ()) -> Sets:
    """The labelled vectors of runs."""
    return gather(find_runs(runs), Labelling(groups, gate_m=GATE_M))[0]


def learned(train_sets: Sets, test_sets: Sets, rule: Rule = RULE) -> dict[str, Outcome]:
    """Models of each set of features and how they do on the held-out scenes."""
    chosen = Settings(
        equal_priors=True, log=True, positive="diver", miss_cost=MISS_COST, repeats=1, discriminant=rule
    )
    return {name: train(one, chosen, {}) for name, one in lessons(train_sets, test_sets, chosen).items()}


def thesis(sets: Sets) -> Sets:
    """The same vectors with the ten and the forty features of the thesis alone."""
    return {
        name: one.columns([feature for feature in one.features if not feature.startswith(MOTION)])
        for name, one in sets.items()
    }


def judged(model: Model, held_out: Samples, miss_cost: float) -> Confusion:
    """Labels of held-out vectors by a model."""
    columns = [held_out.features.index(name) for name in model.feature_names]
    scores = linear(model.gaussians, model.ridge).scores(model.scaling(held_out.values[:, columns]))
    said = decide(posterior(scores), model.class_names.index("diver"), miss_cost, 1.0)
    held_out = held_out.of_classes(model.class_names)
    return confusion(model.class_names, held_out.label, said, held_out.group)


def share(wrong: int, n: int) -> str:
    """A count with its interval, in percent."""
    low, high = interval(wrong, n)
    return f"{wrong:5d} of {n:6d} = {100 * wrong / max(n, 1):6.2f} %  ({100 * low:5.2f} to {100 * high:5.2f})"


def rows(name: str, outcome: Outcome) -> list[str]:
    """What a model does on held-out scenes, diver against the rest."""
    plain, cost = outcome.plain, outcome.weighted
    return [
        f"  {name}: {len(outcome.model.features)} features",
        f"    error, vectors          {share(*both(plain))}",
        f"    error, targets          {share(*both(plain, group=True))}",
        f"    missed divers           {share(*plain.missed('diver'))}",
        f"    others called divers    {share(*plain.called('diver'))}",
        f"    at miss cost {MISS_COST:g}:",
        f"    missed, vectors         {share(*cost.missed('diver'))}",
        f"    missed, targets         {share(*cost.missed('diver', group=True))}",
        f"    others called, vectors  {share(*cost.called('diver'))}",
        f"    others called, targets  {share(*cost.called('diver', group=True))}",
    ]


def held_out(scenes: Scenes) -> dict[str, Outcome]:
    """The main table; gives the four-class linear models."""
    trained, tested = scenes.play(TRAIN), scenes.play(scenes.test)
    for snr_db, faint in FAINT.items():
        trained += scenes.at_snr(faint, snr_db)
    seeds = ", ".join(f"{one[0]}-{one[-1]}" for one in (TRAIN, *FAINT.values()))
    print(f"held out: trained on seeds {seeds}, judged on {scenes.test[0]}-{scenes.test[-1]}")
    train_sets, test_sets = samples(trained), samples(tested)
    outcomes = learned(train_sets, test_sets)
    for name, outcome in outcomes.items():
        counts = ", ".join(f"{k} {n} of {g}" for k, (n, g) in outcome.lesson.test.counts.items())
        print(f"  held-out vectors of targets: {counts}")
        print("\n".join(rows(name, outcome)))
        error = 100 * both(outcome.plain)[0] / both(outcome.plain)[1]
        print(f"    goal {GOAL[name]} %: {'met' if error <= GOAL[name] else 'missed'}")
    as_decided(tested, outcomes["temporal"].model)
    others(trained, tested, train_sets, test_sets)
    return outcomes


def as_decided(tested: Sequence[Path], model: Model) -> None:
    """What the graph's classifier says, block after block."""
    label = labelling().parameters()
    named = ("memory", "handover", "min_descriptions", "agreement")
    print(f"as the graph decides: {', '.join(f'{name} {label[name]}' for name in named)}")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "temporal.json"
        save(path, model)
        for cost in (1.0, 10.0, MISS_COST):
            told = {
                name: decided(tested, path, **{"miss_cost": cost, **settings})
                for name, settings in WAYS.items()
            }
            print(f"  miss cost {cost:g}")
            for name, one in told.items():
                print(f"    {name:24} error {share(*both(one))}")
                print(f"    {'':24} missed {share(*one.missed('diver'))}")
                print(f"    {'':24} called {share(*one.called('diver'))}")
            whole, always = told["labels"], told["nothing withheld"]
            print(f"    {'targets':24} error {share(*both(whole, group=True))}")
            print(f"    {'':24} missed {share(*whole.missed('diver', group=True))}")
            for name, count in (("divers", Confusion.missed), ("others", Confusion.called)):
                kept, every = count(whole, "diver")[1], count(always, "diver")[1]
                print(f"    withheld, {name:14}       {share(every - kept, every)}")


def others(trained: list[Path], tested: list[Path], train_sets: Sets, test_sets: Sets) -> None:
    """Other features, rules and classes."""
    rules: tuple[Rule, ...] = ("linear", "quadratic")
    cases = {
        "four classes": (train_sets, test_sets),
        "four classes, ten and forty features": (thesis(train_sets), thesis(test_sets)),
        "two classes, diver and marine life": (samples(trained, MARINE), samples(tested, MARINE)),
    }
    for case, (train_side, test_side) in cases.items():
        print(case)
        for rule in rules:
            for name, outcome in learned(train_side, test_side, rule).items():
                print(
                    f"  {rule:10} {name:9} error, vectors {share(*both(outcome.plain))}; missed at "
                    f"{MISS_COST:g} {share(*outcome.weighted.missed('diver'))}"
                )


def ablation(scenes: Scenes) -> None:
    """What is left when motion and size, or the echo of the whole body, tell nothing."""
    print("ablation: trained and judged where classes are alike in")
    compare(
        scenes,
        {
            "nothing": [],
            "speed, turns and length": ["sonar.matched_motion=true"],
            "echo of the body": ["sonar.matched_echo=true"],
            "both": ["sonar.matched_motion=true", "sonar.matched_echo=true"],
        },
    )


def clutters(scenes: Scenes) -> None:
    """Other laws of the background."""
    print("clutter: trained and judged in")
    compare(scenes, {"K": ["sonar.clutter=k"], "measured": ["sonar.clutter=measured"]})


def compare(scenes: Scenes, cases: dict[str, list[str]]) -> None:
    """Errors where scenes have these settings, in training as in judging."""
    for case, settings in cases.items():
        name = "-".join(case.split()) if settings else "plain"
        trained, tested = (scenes.play(seeds, name, settings) for seeds in (FEW_TRAIN, FEW_TEST))
        for kind, outcome in learned(samples(trained), samples(tested)).items():
            print(f"  {case:24} {kind:9} error, vectors {share(*both(outcome.plain))}")
            print(f"  {'':24} {'':9}        targets {share(*both(outcome.plain, group=True))}")


def over_snr(scenes: Scenes, outcomes: dict[str, Outcome]) -> dict[str, list[tuple[float, float, float]]]:
    """Where the models that were trained at 20, 14 and 11 dB break down."""
    print("over SNR, models trained at 20 to 11 dB: error of vectors, balanced over the two sides")
    curve: dict[str, list[tuple[float, float, float]]] = {}
    divers: dict[str, int] = {}
    for snr_db in SNRS_DB:
        plain = snr_db == SNRS_DB[0]
        found = samples(scenes.play(FEW_TEST) if plain else scenes.at_snr(FEW_TEST, snr_db))
        for kind, outcome in outcomes.items():
            said = judged(outcome.model, found[kind], 1.0)
            (missed, n), (called, m) = said.missed("diver"), said.called("diver")
            divers.setdefault(kind, n)
            missed_share, called_share = missed / max(n, 1), called / max(m, 1)
            described = n / max(divers[kind], 1)
            curve.setdefault(kind, []).append((snr_db, 0.5 * (missed_share + called_share), described))
            print(
                f"  {snr_db:4.0f} dB {kind:9} error {50 * (missed_share + called_share):6.2f} %, missed "
                f"{100 * missed_share:6.2f} %, called {100 * called_share:6.2f} %; "
                f"described {100 * described:5.1f} % as often as at 20 dB"
            )
    return curve


def main() -> None:
    """Print the tables; draw the picture if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=("held-out", "ablation", "clutter", "snr"), help="[all]")
    parser.add_argument("--pings", type=int, default=500, help="of each scene")
    parser.add_argument("--test", type=int, nargs=2, metavar="SEED", help="first and last [3001 3016]")
    parser.add_argument("--keep", type=Path, help="folder in which scenes are kept, and found again")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    with TemporaryDirectory() as temporary:
        first, last = options.test or (TEST[0], TEST[-1])
        scenes = Scenes(options.keep or Path(temporary), options.pings, range(first, last + 1))
        alone = {"ablation": ablation, "clutter": clutters}.get(options.only)
        if alone is not None:
            return alone(scenes)
        outcomes = held_out(scenes)
        curve = over_snr(scenes, outcomes) if options.only != "held-out" else {}
        if options.only is None:
            ablation(scenes)
            clutters(scenes)
        if options.picture:
            draw(outcomes, curve, options.picture)
        return None


if __name__ == "__main__":
    main()
