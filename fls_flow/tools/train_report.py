"""What a training found: tables, a report to look at, and a document for programs."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fls_flow.errors import UserError
from fls_flow.model_files import save
from fls_flow.tools.train import Outcome
from fls_flow.tools.train_model import Settings
from fls_flow.tools.train_pictures import pictures
from fls_flow.tools.train_scores import Confusion, interval

__all__ = ["Table", "document", "refuse_to_replace", "tables", "write"]

CAPTIONS = {
    "errors": "Error over the number of features (as figures 5.1 and 5.2).",
    "class_errors": "Error of each class over the number of features (as figures 5.3 and 5.4).",
    "scatter": "The two features that part the classes best, with densities and decision: solid for the "
    "more probable class, dashed by cost (as figures 5.5 and 5.6).",
    "roc": "Operating points of the model, with the one that the costs ask for.",
}
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:1rem 0;font-size:14px}
h3{font-size:15px;margin:1.6rem 0 0}
th,td{border-bottom:1px solid #ddd;padding:.15rem .7rem;text-align:left}
.number{text-align:right}
figure{margin:1rem 0}img{max-width:100%}figcaption{color:#555;font-size:14px}
code{background:#f3f3f3;padding:0 .2rem}
"""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text under a header."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(outcome: Outcome) -> tuple[Table, ...]:
    """Analysis of variance, rankings, errors over the number of features, and confusions."""
    return (
        _summary(outcome),
        _variance(outcome),
        _ranking(outcome),
        _joined(outcome),
        _confusion("Held-out vectors, the more probable class (as tables 5.3 and 5.4)", outcome.plain),
        _confusion(f"Held-out vectors, by cost ({_costs(outcome)})", outcome.weighted),
        _confusion("Held-out targets by their most frequent label, by cost", outcome.weighted, group=True),
        _decision(outcome),
    )


def _summary(outcome: Outcome) -> Table:
    rows = []
    for name in outcome.lesson.train.classes:
        vectors = [one.counts[name] for one in (outcome.lesson.train, outcome.lesson.test)]
        rows.append((name, *(f"{n} of {groups} targets" for n, groups in vectors)))
    return Table("Vectors, and the targets they come from", ("class", "trained on", "held out"), tuple(rows))


def _variance(outcome: Outcome) -> Table:
    found = outcome.variance
    order = np.argsort(-np.nan_to_num(found.f_number, nan=-1.0), kind="stable")
    names = outcome.lesson.train.features
    rows = tuple(
        (names[n], f"{found.f_number[n]:.1f}", f"{found.probability[n]:.4f}") for n in order.tolist()
    )
    return Table("One-way analysis of variance (as tables 5.1 and 5.2)", ("feature", "F", "Prob > F"), rows)


def _ranking(outcome: Outcome) -> Table:
    names, error = outcome.lesson.train.features, outcome.alone
    order = np.argsort(np.nan_to_num(error, nan=2.0), kind="stable").tolist()
    rows = tuple((str(rank), names[n], _percent(error[n])) for rank, n in enumerate(order, start=1))
    return Table(
        "Features alone: mean error over random splits by track (as tables 5.5 and 5.6)",
        ("rank", "feature", "error"),
        rows,
    )


def _joined(outcome: Outcome) -> Table:
    names = outcome.lesson.train.features
    rows = []
    for n, (one, held_out) in enumerate(zip(outcome.forward.order, outcome.curve, strict=True)):
        by_class = [_percent(error) for error in held_out.class_error]
        error = _percent(outcome.forward.error[n])
        rows.append((str(n + 1), f"+ {names[one]}", error, _percent(held_out.error), *by_class))
    kind = "cross-validation" if outcome.forward.cross_validated else "training vectors"
    classes = outcome.plain.classes
    return Table("Forward selection", ("features", "", kind, "held out", *classes), tuple(rows))


def _confusion(title: str, found: Confusion, *, group: bool = False) -> Table:
    count = found.group_count if group else found.count
    wrong, n = found.group_wrong if group else found.wrong
    low, high = interval(wrong, n)
    rows = [
        (name, *map(str, row.tolist()), str(row.sum()))
        for name, row in zip(found.classes, count, strict=True)
    ]
    rows.append(("total", *map(str, count.sum(axis=0).tolist()), str(n)))
    what = f"{title}: {wrong} of {n} wrong, {_percent(wrong / n if n else np.nan)} "
    spread = f"(95 %: {_percent(low)} to {_percent(high)} if independent)"
    return Table(what + spread, ("true / label", *found.classes, "total"), tuple(rows))


def _decision(outcome: Outcome) -> Table:
    name = outcome.model.positive
    rows = []
    for what, found in (("the more probable class", outcome.plain), ("by cost", outcome.weighted)):
        for kind, group in (("vectors", False), ("targets", True)):
            missed, called = found.missed(name, group=group), found.called(name, group=group)
            rows.append((f"{what}, {kind}", _of(*missed), _of(*called)))
    return Table(f"{name} against the rest", ("", f"{name} missed", f"others called {name}"), tuple(rows))


def _of(wrong: int, n: int) -> str:
    low, high = interval(wrong, n)
    return f"{wrong} of {n} ({_percent(low)} to {_percent(high)})"


def _costs(outcome: Outcome) -> str:
    model = outcome.model
    return f"missing {model.positive} {model.miss_cost:g}, calling another so {model.false_alarm_cost:g}"


def _percent(share: float | np.floating[Any]) -> str:
    return "" if np.isnan(share) else f"{100.0 * share:.2f} %"


def document(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    """All figures, for programs."""
    return {name: _figures(one) for name, one in outcomes.items()}


def _figures(outcome: Outcome) -> dict[str, Any]:
    names = outcome.lesson.train.features
    return {
        "classes": list(outcome.lesson.train.classes),
        "sides": list(outcome.plain.classes),  # what errors and confusions are between
        "trained_on": {name: list(n) for name, n in outcome.lesson.train.counts.items()},
        "held_out": {name: list(n) for name, n in outcome.lesson.test.counts.items()},
        "anova": {
            name: {"f": _plain(f), "p": _plain(p)}
            for name, f, p in zip(names, outcome.variance.f_number, outcome.variance.probability, strict=True)
        },
        "alone_error": {name: _plain(one) for name, one in zip(names, outcome.alone, strict=True)},
        "forward": {
            "features": [names[one] for one in outcome.forward.order],
            "cross_validated": outcome.forward.cross_validated,
            "error": [_plain(one) for one in outcome.forward.error],
            "held_out_error": [_plain(one.error) for one in outcome.curve],
            "held_out_class_error": [[_plain(e) for e in one.class_error] for one in outcome.curve],
        },
        "model": list(outcome.model.feature_names),
        "costs": {
            "positive": outcome.model.positive,
            "miss": outcome.model.miss_cost,
            "false_alarm": outcome.model.false_alarm_cost,
        },
        "plain": _counted(outcome.plain, outcome.model.positive),
        "by_cost": _counted(outcome.weighted, outcome.model.positive),
        "roc_area": None if outcome.roc is None else outcome.roc.area,
        "notes": list(outcome.lesson.notes),
    }


def _counted(found: Confusion, positive: str) -> dict[str, Any]:
    return {
        "missed": list(found.missed(positive)),
        "false_alarms": list(found.called(positive)),
        "missed_targets": list(found.missed(positive, group=True)),
        "false_alarm_targets": list(found.called(positive, group=True)),
        "confusion": found.count.tolist(),
        "error": _plain(found.error),
        "interval": list(interval(*found.wrong)),
        "class_error": [_plain(one) for one in found.class_error],
        "target_confusion": found.group_count.tolist(),
        "target_error": _plain(found.group_error),
        "target_interval": list(interval(*found.group_wrong)),
    }


def _plain(value: Any) -> float | None:
    number = float(value)
    return number if np.isfinite(number) else None


def refuse_to_replace(out: Path) -> None:
    """Raise UserError when the folder `out` holds something, or is none."""
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file; name a folder")
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f"--out {out}: holds something; name a new folder")


def write(out: Path, outcomes: Mapping[str, Outcome], settings: Settings) -> list[Path]:
    """Write `report.html`, and of each set its model and pictures, into a new folder; gives their paths.

    Raises UserError when the folder holds something or cannot be written.
    """
    files: dict[str, bytes] = {}
    sections = []
    for name, outcome in outcomes.items():
        drawn = pictures(outcome, settings)
        files.update({f"{name}_{what}.png": image for what, image in drawn.items()})
        sections.append(_section(name, outcome, drawn))
    title = "Training report"
    page = f"<!doctype html><meta charset=utf-8><title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    files["report.html"] = (page + "".join(sections)).encode()
    try:
        refuse_to_replace(out)
        out.mkdir(parents=True, exist_ok=True)
        for name, outcome in outcomes.items():
            save(out / f"{name}.json", outcome.model)
        for file, content in files.items():
            (out / file).write_bytes(content)
    except OSError as error:
        raise UserError(f"--out {out}: cannot be written ({error.strerror or error})") from error
    return [out / "report.html", *(out / f"{name}.json" for name in outcomes)]


def _section(name: str, outcome: Outcome, drawn: Mapping[str, bytes]) -> str:
    chosen = ", ".join(
        one.name if one.log_offset is None else f"ln {one.name}" for one in outcome.model.features
    )
    parts = [f"<h2>{html.escape(name)}</h2><p>The model takes <code>{html.escape(chosen)}</code>.</p>"]
    parts += [f"<p>{html.escape(note)}</p>" for note in outcome.lesson.notes]
    parts += [_html(table) for table in tables(outcome)]
    for what, image in drawn.items():
        text = base64.b64encode(image).decode()
        parts.append(
            f'<figure><img alt="{html.escape(CAPTIONS[what])}" src="data:image/png;base64,{text}">'
            f"<figcaption>{html.escape(CAPTIONS[what])}</figcaption></figure>"
        )
    return "".join(parts)


def _html(table: Table) -> str:
    numeric = [all(_is_number(row[n]) for row in table.rows) for n in range(len(table.header))]

    def row(cells: Sequence[str], tag: str) -> str:
        kinds = [" class=number" if number else "" for number in numeric]
        parts = zip(cells, kinds, strict=True)
        return "<tr>" + "".join(f"<{tag}{kind}>{html.escape(one)}</{tag}>" for one, kind in parts) + "</tr>"

    body = "".join(row(cells, "td") for cells in table.rows)
    return f"<h3>{html.escape(table.title)}</h3><table>{row(table.header, 'th')}{body}</table>"


def _is_number(cell: str) -> bool:
    return not cell or cell[0].isdigit() or cell in ("nan", "inf")
