"""Topics of an MCAP recording as the CSV files that programs exchange, line by line.

`run.mcap#tracks` stands for the topic `tracks` of `run.mcap` wherever a CSV file may be named.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import repeat
from pathlib import Path
from typing import Any

from fls_flow import wire
from fls_flow.errors import InputError, UserError
from fls_flow.messages import Classes, Detections, Intensity, Message, Tracks, TrackStatus, Truth
from fls_flow.recording import Recording

__all__ = ["csv_lines", "is_topic", "topics_of"]

SUFFIX = ".mcap"
Cells = tuple[Any, ...]


def is_topic(path: Path) -> bool:
    """Whether the path names a topic of a recording."""
    return f"{SUFFIX}#" in path.name


def topics_of(path: Path) -> list[Path]:
    """The topics of a recording that can be scored, as paths; raises UserError."""
    try:
        known = Recording(path).topics()
    except InputError as error:
        raise UserError(str(error)) from error
    names = {wire.schema(kind).name for kind in _KINDS}
    found: dict[str, str] = {}
    for topic in sorted(known.values(), key=lambda topic: topic.name):
        if topic.type_name in names:
            if topic.type_name in found:
                one, other = (f"{path}#{name}" for name in (found[topic.type_name], topic.name))
                raise UserError(
                    f"{path}: two topics hold {topic.type_name}; name one of them: {one} or {other}"
                )
            found[topic.type_name] = topic.name
    return [path.with_name(f"{path.name}#{name}") for name in found.values()]


def csv_lines(path: Path) -> Generator[str, None, None]:
    """The lines of the CSV file that a sink would have written of the topic; raises UserError."""
    name, _, topic = path.name.partition("#")
    recording = Recording(path.with_name(name))
    try:
        kind = recording.message_type(topic)
        if kind not in _KINDS:
            raise UserError(f"{path}: holds {kind.__name__}, which is not scored")
        header, entries = _KINDS[kind]
        yield ",".join(("seq", "stamp_ns", *header)) + "\n"
        for message, classes in zip(recording.messages(topic), _classes(recording, kind), strict=False):
            yield from _lines(message, classes, len(header), entries)
    except InputError as error:
        raise UserError(str(error)) from error


def _classes(recording: Recording, kind: type) -> Iterable[Classes | None]:
    """What tracks are taken for, firing by firing, if the recording has it once."""
    name = wire.schema(Classes).name
    topics = [topic.name for topic in recording.topics().values() if topic.type_name == name]
    if kind is Tracks and len(topics) == 1:
        return recording.messages(topics[0])  # type: ignore[return-value]  # of that class by its schema
    return repeat(None)


def _lines(
    message: Message, classes: Classes | None, width: int, entries: Callable[..., Iterator[Cells]]
) -> Iterator[str]:
    beside = classes if classes is not None and classes.stamp_ns == message.stamp_ns else None
    head: Cells = (message.seq, message.stamp_ns)
    if isinstance(message, Intensity):
        head, width = (*head, message.expected_targets), width - 1
    text = io.StringIO(newline="")
    rows = list(entries(message, beside)) or [("",) * width]
    csv.writer(text, lineterminator="\n").writerows((*head, *row) for row in rows)
    yield from text.getvalue().splitlines(keepends=True)


def _tracks(tracks: Tracks, classes: Classes | None) -> Iterator[Cells]:
    described = {} if classes is None else _described(classes)
    for number in range(len(tracks)):
        P, track_id = tracks.covariance[number], int(tracks.id[number])
        yield (
            track_id,
            TrackStatus(int(tracks.status[number])).name.lower(),
            *tracks.state[number].tolist(),
            float(P[0, 0]),
            float(P[0, 1]),
            float(P[1, 1]),
            *described.get(track_id, ("", "")),
            tracks.frame,
        )


def _described(classes: Classes) -> dict[int, tuple[str, float]]:
    return {
        int(track_id): (classes.names[label], float(classes.posterior[row, label]))
        for row, (track_id, label) in enumerate(zip(classes.track_id, classes.label, strict=True))
        if 0 <= label < len(classes.names)
    }


def _truth(truth: Truth, _: None) -> Iterator[Cells]:
    for target_id, state, word in zip(
        truth.target_id.tolist(), truth.state.tolist(), truth.class_name, strict=True
    ):
        yield target_id, *state, word, truth.frame


def _detections(detections: Detections, _: None) -> Iterator[Cells]:
    yield from zip(
        detections.range_m.tolist(),
        detections.bearing_rad.tolist(),
        detections.amplitude.tolist(),
        strict=True,
    )


def _estimates(intensity: Intensity, _: None) -> Iterator[Cells]:
    for state, weight in zip(intensity.state.tolist(), intensity.weight.tolist(), strict=True):
        yield *state, weight, intensity.frame


_STATE = ("x_m", "y_m", "vx_mps", "vy_mps")
_KINDS: dict[type, tuple[tuple[str, ...], Callable[..., Iterator[Cells]]]] = {
    Tracks: (
        ("track_id", "status", *_STATE, "var_x", "cov_xy", "var_y", "label", "probability", "frame"),
        _tracks,
    ),
    Truth: (("target_id", *_STATE, "class", "frame"), _truth),
    Detections: (("range_m", "bearing_rad", "amplitude"), _detections),
    Intensity: (("expected_targets", *_STATE, "weight", "frame"), _estimates),
}
