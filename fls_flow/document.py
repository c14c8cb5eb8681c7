"""YAML in which every value knows where it stands: `file:line`, for errors that say what to mend.

YAML 1.2, so `1e-6` is a number and `on` is a word. Plain data only: no tags, no objects. Size, depth and the
number of values are bounded, aliases included, so that no file can fill the memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

from fls_flow.errors import GraphError, Problem

__all__ = ["Value", "parse", "plain", "read"]

MAX_BYTES = 1_000_000
MAX_VALUES = 100_000
MAX_DEPTH = 32
TAGS = "tag:yaml.org,2002:"


@dataclass(frozen=True, slots=True)
class Value:
    """A scalar, a list of values or a mapping of names to values, and where it stands."""

    where: str
    data: Any
    folder: Path | None = None  # of the file that it stands in; None: the command line

    def at(self, what: str) -> Problem:
        """A problem with this value."""
        return Problem(self.where, what)

    @property
    def mapping(self) -> dict[str, Value]:
        """The values by name; empty when this is no mapping."""
        return self.data if isinstance(self.data, dict) else {}


def plain(value: Value) -> Any:
    """The value without its positions."""
    if isinstance(value.data, dict):
        return {name: plain(child) for name, child in value.data.items()}
    if isinstance(value.data, list):
        return [plain(child) for child in value.data]
    return value.data


def read(path: Path, problems: list[Problem]) -> Value:
    """The document in the file `path`; what is wrong inside is added to `problems`.

    Raises GraphError when there is nothing to go on with: no file, too large, not UTF-8, not YAML.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise GraphError([Problem(str(path), f"is larger than {MAX_BYTES} bytes: not a graph file")])
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise GraphError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error
    except UnicodeDecodeError as error:
        what = f"is not UTF-8 text (byte {error.start}); save it as UTF-8"
        raise GraphError([Problem(str(path), what)]) from error
    return parse(text, str(path), problems, folder=path.resolve().parent)


def parse(
    text: str, source: str, problems: list[Problem], *, folder: Path | None = None, lines: bool = True
) -> Value:
    """The document in `text`; `source` names it in errors, with the line if `lines`."""
    try:
        yaml = YAML(typ="safe", pure=True)
        yaml.allow_duplicate_keys = True  # reported below, with all the others
        root = yaml.compose(text)
    except YAMLError as error:
        raise GraphError([_syntax(error, source, lines)]) from error
    except (ValueError, RecursionError) as error:
        raise GraphError([Problem(source, f"is not YAML: {type(error).__name__}")]) from error
    if root is None:
        return Value(f"{source}:1" if lines else source, None, folder)
    return _Walk(source, problems, folder, lines).value(root, 0)


def _syntax(error: YAMLError, source: str, lines: bool) -> Problem:
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None) or str(error).splitlines()[0]
    where = f"{source}:{mark.line + 1}" if mark is not None and lines else source
    return Problem(where, f"is not YAML: {what}")


class _Walk:
    """Turns ruamel's nodes into values, counting them."""

    def __init__(self, source: str, problems: list[Problem], folder: Path | None, lines: bool) -> None:
        self.source, self.problems, self.folder, self.lines = source, problems, folder, lines
        self.count = 0
        self.construct = SafeConstructor(loader=YAML(typ="safe", pure=True))

    def value(self, node: Any, depth: int) -> Value:
        where = f"{self.source}:{node.start_mark.line + 1}" if self.lines else self.source
        self.count += 1
        if depth > MAX_DEPTH or self.count > MAX_VALUES:
            limit = f"{MAX_DEPTH} levels" if depth > MAX_DEPTH else f"{MAX_VALUES} values (aliases count)"
            raise GraphError([Problem(where, f"has more than {limit}: not a graph file")])
        if not str(node.tag).startswith(TAGS) or str(node.tag).startswith(TAGS + "python/"):
            self.problems.append(Problem(where, f"the tag {node.tag} is not allowed; write plain values"))
            return Value(where, None, self.folder)
        if isinstance(node, MappingNode):
            return Value(where, self.mapping(node, depth), self.folder)
        if isinstance(node, SequenceNode):
            return Value(where, [self.value(child, depth + 1) for child in node.value], self.folder)
        return Value(where, self.scalar(node, where), self.folder)

    def mapping(self, node: MappingNode, depth: int) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for key_node, value_node in node.value:
            value = self.value(value_node, depth + 1)
            where = f"{self.source}:{key_node.start_mark.line + 1}" if self.lines else self.source
            if not isinstance(key_node, ScalarNode):
                self.problems.append(Problem(where, "a key is a list or a mapping; use a word"))
                continue
            key = str(key_node.value)
            if key in found:
                self.problems.append(Problem(where, f"duplicate key '{key}', first at {found[key].where}"))
            else:
                found[key] = value
        return found

    def scalar(self, node: ScalarNode, where: str) -> Any:
        tag = str(node.tag).removeprefix(TAGS)
        if tag not in ("null", "bool", "int", "float", "str"):
            return node.value  # dates and the like stay the text that was written
        try:
            constructed = getattr(self.construct, f"construct_yaml_{tag}")(node)
        except (ValueError, KeyError, YAMLError):
            self.problems.append(Problem(where, f"'{node.value}' is not a {tag}"))
            return None
        return float(constructed) if tag == "float" else constructed
