"""YAML in which every value knows where it stands: `file:line`, for errors that say what to mend.

YAML 1.2 with its core schema, so `1e-6` is a number and `on` is a word. Plain data only: no tags, no merge
keys, no directives. Size, depth and the number of values are bounded, aliases included, so that no file can
fill the memory.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

from fls_flow.errors import GraphError, Problem

__all__ = ["Value", "parse", "plain", "read", "shown"]

MAX_BYTES = 250_000
MAX_VALUES = 50_000
MAX_DEPTH = 32
MAX_DIGITS = 300  # of an int; longer ones stay text, which no number takes
MAX_SHOWN = 80
TAGS = "tag:yaml.org,2002:"

# the core schema, YAML 1.2.2 section 10.3.2
_WORDS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INT = re.compile(r"[-+]?[0-9]+")
_BASED = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


@dataclass(frozen=True, slots=True)
class Value:
    """A scalar, a list of values or a mapping of names to values, and where it stands."""

    where: str  # of its key, if it has one
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


def shown(value: Value) -> str:
    """The value as it can be written, on one line that is cut when long."""
    text = json.dumps(plain(value), ensure_ascii=False)
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


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
    """The document in `text`; `source` names it in errors, with the line if `lines`.

    Raises GraphError when it is no YAML, or more than plain data.
    """
    walk = _Walk(source, problems, folder, lines)
    text = text.removeprefix("\ufeff")
    _refuse_directives(text, walk)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an anchor may be used again
            root = YAML(typ="safe", pure=True).compose(text)
    except YAMLError as error:
        raise GraphError([*problems, _syntax(error, walk)]) from error
    except RecursionError as error:
        raise GraphError([*problems, Problem(source, "is nested too deep: not a graph file")]) from error
    except Exception as error:  # on garbage the parser raises ValueError, AssertionError...
        raise GraphError([*problems, Problem(source, f"is not YAML: {type(error).__name__}")]) from error
    return Value(walk.place(0), None, folder) if root is None else walk.value(root, 0)


def _refuse_directives(text: str, walk: _Walk) -> None:
    for number, line in enumerate(text.split("\n")):
        if line.startswith("%"):
            what = "directives (%YAML, %TAG) are not allowed; remove the line: graph files are YAML 1.2"
            raise GraphError([Problem(walk.place(number), what)])
        if line.strip() and not line.lstrip().startswith("#"):
            return


def _syntax(error: YAMLError, walk: _Walk) -> Problem:
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None) or str(error).splitlines()[0]
    where = walk.place(mark.line) if mark is not None else walk.source
    if what == "but found another document":
        return Problem(where, "begins a second document; a graph file holds one")
    hint = "; use spaces, not tabs" if "'\\t'" in what else ""
    return Problem(where, f"is not YAML: {what}{hint}")


class _Walk:
    """Turns ruamel's nodes into values, counting them."""

    def __init__(self, source: str, problems: list[Problem], folder: Path | None, lines: bool) -> None:
        self.source, self.problems, self.folder, self.lines = source, problems, folder, lines
        self.count = 0
        self.implicit = YAML(typ="safe", pure=True).resolver.resolve

    def place(self, line: int) -> str:
        """`file:line` for a line counted from 0."""
        return f"{self.source}:{line + 1}" if self.lines else self.source

    def value(self, node: Any, depth: int, where: str = "") -> Value:
        where = where or self.place(node.start_mark.line)
        self.count += 1
        if depth > MAX_DEPTH or self.count > MAX_VALUES:
            limit = f"{MAX_DEPTH} levels" if depth > MAX_DEPTH else f"{MAX_VALUES} values (aliases count)"
            raise GraphError([*self.problems, Problem(where, f"has more than {limit}: not a graph file")])
        self.untagged(node, where)
        if isinstance(node, MappingNode):
            return Value(where, self.mapping(node, depth), self.folder)
        if isinstance(node, SequenceNode):
            return Value(where, [self.value(child, depth + 1) for child in node.value], self.folder)
        return Value(where, self.scalar(node, where), self.folder)

    def untagged(self, node: Any, where: str) -> None:
        """Report a tag; the value is read on as if there were none."""
        if isinstance(node, ScalarNode):
            fits = self.implicit(ScalarNode, node.value, (True, False)) if not node.style else f"{TAGS}str"
        else:
            fits = TAGS + ("map" if isinstance(node, MappingNode) else "seq")
        if str(node.tag) != str(fits):
            tag = str(node.tag).replace(TAGS, "!!")
            self.problems.append(Problem(where, f"the tag {tag} is not allowed; write plain values"))

    def mapping(self, node: MappingNode, depth: int) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for key_node, value_node in node.value:
            where = self.place(key_node.start_mark.line)
            value = self.value(value_node, depth + 1, where)
            if not isinstance(key_node, ScalarNode):
                self.problems.append(Problem(where, "a key is a list or a mapping; use a word"))
                continue
            key = self.key(key_node, where)
            if key in found:
                self.problems.append(Problem(where, f"duplicate key '{key}', first at {found[key].where}"))
            else:
                found[key] = value
        return found

    def key(self, node: ScalarNode, where: str) -> str:
        if str(node.tag) == TAGS + "merge":
            what = "merge keys (<<) are not allowed; write the keys out, or put them into a graph for base:"
            raise GraphError([*self.problems, Problem(where, what)])
        self.untagged(node, where)
        return self.text(node, where)

    def scalar(self, node: ScalarNode, where: str) -> Any:
        text = self.text(node, where)
        if node.style:
            return text  # quoted, or a block
        if text in _WORDS:
            return _WORDS[text]
        if _INT.fullmatch(text) or _BASED.fullmatch(text):
            return int(text, 10 if _INT.fullmatch(text) else 0) if len(text) <= MAX_DIGITS else text
        if _SPECIAL.fullmatch(text):
            return float(text.replace(".", ""))
        if _FLOAT.fullmatch(text) and math.isfinite(float(text)):
            return float(text)
        return text

    def text(self, node: ScalarNode, where: str) -> str:
        text = str(node.value)
        if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
            self.problems.append(Problem(where, "text holds NUL or half a surrogate pair; remove it"))
            return ""
        return text
