"""Calls into a node's own code: what it raises becomes an error with its name and one line of cause."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any

from fls_flow.errors import NodeError
from fls_flow.graph import Node
from fls_flow.messages import Message
from fls_flow.runtime import answer

__all__ = [
    "abandoned",
    "answered",
    "cause_of",
    "closed",
    "iterated",
    "made",
    "not_a_copy",
    "not_ctrl_c",
    "source_outputs",
]


def closed(node: Node, instance: Any, patience_s: float) -> NodeError | None:
    """Close an instance; what went wrong, such as that it does not come to an end."""
    close = getattr(instance, "close", None)
    if close is None:
        return None
    raised: list[BaseException] = []

    def call() -> None:
        try:
            close()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=call, name=f"{node.name}-close", daemon=True)
    thread.start()
    thread.join(patience_s)
    if not raised:
        hung = thread.is_alive()
        return NodeError(node.name, None, None, f"close() takes over {patience_s:g} s") if hung else None
    failure = NodeError(node.name, None, None, f"while closing: {cause_of(raised[0])}")
    failure.__cause__ = raised[0]
    return failure


def cause_of(error: BaseException) -> str:
    """An exception on one line, whatever it is."""
    try:
        text = " ".join(str(error).split())
    except Exception:
        text = "which cannot say why"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def source_outputs(node: Node, produced: Any, index: int) -> dict[str, Message]:
    """What a source has made, checked: all its ports fire together, for one ping.

    Raises NodeError.
    """
    try:
        outputs = answer.named(node.kind, produced)
        first = next(iter(outputs.values()))
        answer.same_ping(outputs.values(), first.seq, first.stamp_ns)
    except answer.AnswerError as error:
        raise NodeError(node.name, index, None, str(error)) from error
    return outputs


def answered(instance: Any, inputs: dict[str, Any]) -> Any:
    """What a node answers; raises what it raises."""
    process = os.getpid()
    try:
        return instance(**inputs)
    finally:
        not_a_copy(process)


def iterated(node: Node, instance: Any) -> Iterator[Any]:
    """The source's iterator; raises NodeError with the cause."""
    try:
        return iter(instance())
    except BaseException as error:
        not_ctrl_c(error)
        raise NodeError(node.name, None, None, cause_of(error)) from error


def made(node: Node, iterator: Iterator[Any], index: int) -> Any | None:
    """What the source makes next, None at its end; raises NodeError with the cause."""
    process = os.getpid()
    try:
        return next(iterator, None)
    except BaseException as error:
        not_ctrl_c(error)
        raise NodeError(node.name, index, None, cause_of(error)) from error
    finally:
        not_a_copy(process)


def abandoned(node: Node, iterator: Iterator[Any], index: int) -> None:
    """End a generator, so that what it holds open is closed; raises NodeError with the cause."""
    try:
        getattr(iterator, "close", lambda: None)()
    except BaseException as error:
        not_ctrl_c(error)
        raise NodeError(node.name, index, None, f"while closing: {cause_of(error)}") from error


def not_a_copy(process: int) -> None:
    """End this process unless it is `process`: a copy that the node has forked has come back from the call.

    It shares sockets and files with the run, which goes on without it.
    """
    if os.getpid() != process:
        os._exit(0)


def not_ctrl_c(error: BaseException) -> None:
    """Let Ctrl-C pass, which comes to nodes that run in the main thread; no node may raise it."""
    if isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
        raise error
