"""`fls-flow train`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fls_flow.cli.common import JSON, SET, USE, screen
from fls_flow.errors import UserError

if TYPE_CHECKING:
    from fls_flow.tools.train import Lesson, Outcome
    from fls_flow.tools.train_model import Settings
    from fls_flow.tools.train_samples import Labelling

__all__ = ["train"]

LABELLING = ("gate_m", "share", "clutter")
COSTS = ("positive", "miss_cost", "false_alarm_cost")
CHOICE = ("features", "ridge", "repeats", "folds", "equal_priors", "against_rest", "log", "discriminant")
SETTINGS = ("train_share", "seed", *CHOICE, *COSTS)


@click.command()
@click.argument("paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--truth", type=click.Path(exists=True, path_type=Path), help="truth.csv [beside the tables].")
@click.option("--labels", type=click.Path(exists=True, path_type=Path),
              help="What the tracks are: track_id,class [labels.csv beside the tables].")  # fmt: skip
@click.option("--graph", default="diver_labelling", show_default=True,
              help="What describes the tracks of recordings.")  # fmt: skip
@click.option("--runs", type=click.Path(path_type=Path), default=Path("runs/train"), show_default=True,
              help="Where its runs over recordings go, and are found again.")  # fmt: skip
@USE
@SET
@click.option("--test", multiple=True, type=click.Path(exists=True, path_type=Path),
              help="Runs to hold out; without it, a part of the targets of PATHS. Repeatable.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default=Path("training"), show_default=True,
              help="New folder for report and models.")  # fmt: skip
@click.option("--group", "groups", multiple=True, metavar="CLASS=A,B*",
              help="Count classes that match A or B* as CLASS; the first such. Repeatable.")  # fmt: skip
@click.option("--clutter", metavar="CLASS", help="Class of tracks that follow no target [left out].")
@click.option("--gate-m", type=float, default=5.0, show_default=True, help="A track this close follows.")
@click.option("--share", type=float, default=0.5, show_default=True,
              help="In this share of its pings at least.")  # fmt: skip
@click.option("--by-track", is_flag=True, help="Split by track, never by ping: so it is always done.")
@click.option("--train-share", type=float, default=0.5, show_default=True, help="Of each class's targets.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the random splits.")
@click.option("--features", type=int, help="How many to take [what cross-validation finds best].")
@click.option("--only", metavar="A,B*", help="Consider only features that match.")
@click.option("--ridge", type=float, default=1e-6, show_default=True, help="Added to standardised variances.")
@click.option("--repeats", type=int, default=100, show_default=True, help="Splits of the ranking.")
@click.option("--folds", type=int, default=5, show_default=True, help="Of the cross-validation.")
@click.option("--positive", metavar="CLASS", help="Whose miss has a cost [diver, or the first by name].")
@click.option("--miss-cost", type=float, default=1.0, show_default=True, help="Of missing that class.")
@click.option("--false-alarm-cost", type=float, default=1.0, show_default=True, help="Of wrongly calling it.")
@click.option("--equal-priors", is_flag=True, help="Take classes for equally frequent.")
@click.option("--against-rest", is_flag=True,
              help="Keep all classes, but count only mistakes with the positive one.")  # fmt: skip
@click.option("--log", is_flag=True, help="Take logarithms of features that are less skew so.")
@click.option("--discriminant", type=click.Choice(["linear", "quadratic"]), default="linear",
              show_default=True, help="What features are chosen for; the model serves both.")  # fmt: skip
@click.option("--no-progress", is_flag=True, help="No progress bar.")
@JSON
def train(paths: tuple[Path, ...], **options: Any) -> None:
    """Train classifiers on PATHS: recordings, feature tables (CSV, Parquet), or folders of either.

    Recordings are run through the graph first, with the pings of the recording in place of its own. What a
    track is comes from the truth beside the recording or table, from labels.csv (track_id,class) or from a
    column `class`. Each table's name is a set of features (static, temporal); each set gets a model, and a
    chapter of the report.

    \b
    Examples:
      fls-flow train runs/diver-training --group "marine-life=seal,dolphin,fish*" --miss-cost 100
      fls-flow train runs/diver-training --against-rest --discriminant quadratic --positive diver
      fls-flow train runs/seeds-0-9 --test runs/seeds-10-19 --out training/held-out-by-seed
      fls-flow train features.parquet --truth truth.csv --by-track
      fls-flow train harbour.npz --set sonar.range_max_m=60 --labels labels.csv --miss-cost 100
    """
    from fls_flow.tools.train_report import document, refuse_to_replace, tables, write

    refuse_to_replace(options["out"])
    labelling, settings = _settings(options)
    lessons, provenance = _lessons(paths, labelling, settings, options)
    shown = not (options["as_json"] or options["no_progress"])
    outcomes = _outcomes(lessons, settings, provenance, shown=shown)
    written = write(options["out"], outcomes, settings)
    if options["as_json"]:
        click.echo(json.dumps({"out": str(options["out"]), "sets": document(outcomes)}))
        return
    for name, outcome in outcomes.items():
        click.echo(f"{name}: the model takes {', '.join(outcome.model.feature_names)}")
        for table in tables(outcome)[-4:]:
            _print(table)
        for note in outcome.lesson.notes:
            click.echo(f"note: {name}: {note}", err=True)
    for path in written:
        click.echo(f"wrote {path}", err=True)


def _settings(options: dict[str, Any]) -> tuple[Labelling, Settings]:
    from fls_flow.evaluate.classifier import parse_group
    from fls_flow.tools.train_model import Settings
    from fls_flow.tools.train_samples import Labelling

    try:
        labelling = Labelling(
            tuple(parse_group(one) for one in options["groups"]),
            **{name: options[name] for name in LABELLING},
        )
        return labelling, Settings(**{name: options[name] for name in SETTINGS})
    except ValueError as error:
        name, rest = str(error).split(" ", 1)
        raise UserError(f"--{name.replace('_', '-')} {rest}") from error


def _lessons(
    paths: tuple[Path, ...], labelling: Labelling, settings: Settings, options: dict[str, Any]
) -> tuple[dict[str, Lesson], dict[str, Any]]:
    from fls_flow.tools import train as tools
    from fls_flow.tools.train_samples import gather, only
    from fls_flow.tools.train_tables import find_runs

    tables, test = _described(paths, options), _described(options["test"], options)
    with screen(stderr=True).status("reading"):
        sets, provenance = gather(find_runs(tables, options["truth"], options["labels"]), labelling)
        held_out = gather(find_runs(test), labelling)[0] if test else None
    if options["only"]:
        sets = {name: only(one, options["only"]) for name, one in sets.items()}
        if held_out is not None:
            held_out = {name: only(one, options["only"]) for name, one in held_out.items()}
    return tools.lessons(sets, held_out, settings), provenance


def _described(paths: tuple[Path, ...], options: dict[str, Any]) -> list[Path]:
    """The tables to read: recordings become runs of the graph."""
    from rich.progress import Progress

    from fls_flow.tools.train_recordings import Describing, prepared

    how = Describing(options["graph"], options["runs"], options["use"], options["set_"])
    shown = not (options["as_json"] or options["no_progress"])
    with Progress(console=screen(stderr=True), disable=not shown, transient=True) as bar:

        def told(recording: Path) -> Any:
            task = bar.add_task(f"{recording.name}: describing tracks")
            return lambda done, total: bar.update(task, completed=done, total=total)

        taken, unknown = prepared(paths, how, told)
    if unknown and not (options["truth"] or options["labels"]):
        raise UserError(
            f"{unknown[0]}: nothing says what its tracks are; look at its pictures, write labels.csv "
            "(track_id,class) into it, then run the same command again"
        )
    return taken


def _outcomes(
    lessons: dict[str, Lesson], settings: Settings, provenance: dict[str, Any], *, shown: bool
) -> dict[str, Outcome]:
    from rich.progress import Progress

    from fls_flow.tools import train as tools

    with Progress(console=screen(stderr=True), disable=not shown, transient=True) as bar:
        outcomes = {}
        for name, lesson in lessons.items():
            task = bar.add_task(f"{name}: joining features", total=lesson.most_features(settings))
            outcomes[name] = tools.train(
                lesson, settings, provenance, lambda done, task=task: bar.update(task, completed=done)  # type: ignore[misc]  # mypy takes the default for an argument
            )  # fmt: skip
        return outcomes


def _print(table: Any) -> None:
    from rich.table import Table

    click.echo(table.title)
    shown = Table()
    for number, name in enumerate(table.header):
        shown.add_column(name, justify="left" if number == 0 else "right")
    for row in table.rows:
        shown.add_row(*row)
    screen(stderr=False).print(shown)
