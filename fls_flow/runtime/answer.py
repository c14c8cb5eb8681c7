"""What a node may answer: every ping, with the promised messages, for the ping that was asked about."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np

from fls_flow.catalog import Kind
from fls_flow.messages import Message, Sealed

__all__ = ["AnswerError", "empty", "named", "same_ping", "sealed"]


class AnswerError(Exception):
    """An answer breaks the contract; the text says how."""


def named(kind: Kind, answer: Any) -> dict[str, Message]:
    """The messages by port.

    Raises AnswerError for None (unless the node is a sink) and for a type that the signature does not
    promise.
    """
    if not kind.outputs:
        if answer is not None:
            raise AnswerError(f"a sink returns None, not {type(answer).__name__}")
        return {}
    if kind.bundle is not None:
        if not isinstance(answer, kind.bundle):
            raise AnswerError(f"it answered {_said(answer)}, not {kind.bundle.__name__}")
        messages = {port.name: getattr(answer, port.name) for port in kind.outputs}
    else:
        messages = {kind.outputs[0].name: answer}
    for port in kind.outputs:
        if not isinstance(messages[port.name], port.message):
            which = f" for output '{port.name}'" if kind.bundle is not None else ""
            raise AnswerError(
                f"it answered {_said(messages[port.name])}{which}, not {port.message.__name__}; a node "
                "answers every ping, with an empty message if it has nothing to say"
            )
    return {name: sealed(message) for name, message in messages.items()}


def _said(answer: Any) -> str:
    return "None" if answer is None else type(answer).__name__


def same_ping(messages: Iterable[Message], seq: int, stamp_ns: int) -> None:
    """Raises AnswerError unless all messages carry this ping's number and stamp."""
    for message in messages:
        if message.seq != seq:
            raise AnswerError(f"it answered seq {message.seq} to the ping seq {seq}; copy it from the input")
        if message.stamp_ns != stamp_ns:
            raise AnswerError(
                f"it answered stamp_ns {message.stamp_ns} to a ping of {stamp_ns}; copy it from the input"
            )


def sealed(message: Message) -> Message:
    """The message with its arrays read-only, also when its class does not see to that itself."""
    if not isinstance(message, Sealed):
        for one in fields(message):  # type: ignore[arg-type]  # the catalogue lets only dataclasses through
            value = getattr(message, one.name)
            if isinstance(value, np.ndarray) and value.flags.writeable:
                view = value.view()
                view.flags.writeable = False
                object.__setattr__(message, one.name, view)
    return message


def empty(kind: Kind, seq: int, stamp_ns: int) -> dict[str, Message]:
    """Empty messages on all ports; `check` has seen that the classes have defaults."""
    return {port.name: port.message(seq, stamp_ns) for port in kind.outputs}
