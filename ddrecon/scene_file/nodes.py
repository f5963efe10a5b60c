"""YAML text as a tree of nodes that know their key path and where they were written.

The strict part of YAML: one document of mappings, lists and scalars; no tags or repeated keys.
Aliases are written out. What plain scalars mean is the core schema of
YAML 1.2 (section 10.3.2), which has no merge key `<<`: `1e-3` is a number, `yes` is text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ddrecon.errors import Problems, SceneError

Scalar = None | bool | int | float | str

MAX_DEPTH = 32
TOO_DEEP = f"nested more than {MAX_DEPTH} deep"
MAX_NODES = 100_000
"""A few aliases could stand for billions of values."""
TAGS = {f"tag:yaml.org,2002:{kind}" for kind in ("str", "seq", "map")}
"""Those that nodes have of which a file says none."""
LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""The parser in C, where it is there: some twenty times faster."""

Locate = Callable[[int, int], str]
"""Tells where a 1-based line and column are: `file:line:column`, or the override they belong to."""


@dataclass
class Node:
    """A value at the dotted path `key`, written at `where` (its key at `key_where`).

    Relative paths in it start at `folder`, None for that of what is around it.
    """

    key: str
    where: str
    key_where: str
    value: Scalar | list[Node] | dict[str, Node]
    folder: Path | None = None

    def refused(self, what: str) -> SceneError:
        """The error that says `what` is wrong with this value."""
        return SceneError(": ".join(filter(None, (self.where, self.key, what))))

    def key_refused(self, what: str) -> SceneError:
        """The error that says `what` is wrong with the key of this value."""
        return SceneError(f"{self.key_where}: {self.key}: {what}")

    def child_key(self, name: object) -> str:
        """The path of the child called `name`."""
        return f"{self.key}.{name}" if self.key else str(name)

    def children(self) -> list[Node]:
        """The nodes right below this one."""
        if isinstance(self.value, dict):
            return list(self.value.values())
        return self.value if isinstance(self.value, list) else []

    def entries(self) -> dict[str, Node]:
        """The nodes right below this one by name; raises SceneError where it is no mapping."""
        if not isinstance(self.value, dict):
            raise self.refused(f"expected a mapping, found {describe_found(self)}")
        return self.value

    def walk(self) -> Iterator[Node]:
        """This node and every node below it."""
        yield self
        for child in self.children():
            yield from child.walk()


def describe_found(node: Node) -> str:
    """What `node` holds, in words, for an error message."""
    if isinstance(node.value, dict):
        return "a mapping"
    if isinstance(node.value, list):
        return f"a list of {len(node.value)}"
    if node.value is None:
        return "nothing"
    if isinstance(node.value, bool):
        return str(node.value).lower()
    text = repr(node.value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def parse(text: str, locate: Locate, problems: Problems, key: str = "") -> Node:
    """The tree of the YAML (or JSON) document `text`, whose root is at `key`.

    Repeated keys go to `problems`.

    Raises SceneError where the text has no such tree: broken syntax, several documents, tags.
    """
    try:
        _require_shallow(text, locate)
        if (source := yaml.compose(text, Loader=LOADER)) is None:
            raise SceneError(f"{locate(1, 1)}: is empty")
        return _Builder(locate, problems).build(source, key, None, 0)
    except yaml.MarkedYAMLError as error:
        where = _place(locate, error.problem_mark or error.context_mark)
        what = ", ".join(filter(None, (error.context, error.problem)))
    except UnicodeEncodeError:
        where, what = locate(1, 1), "its text is not UTF-8"
    except yaml.reader.ReaderError as error:
        before = text.encode(errors="replace")[: error.position].decode(errors="ignore")
        where = locate(before.count("\n") + 1, len(before) - before.rfind("\n"))
        what = f"the character {error.character!r} is not allowed"
    raise SceneError(f"{where}: not YAML: {what}")


def _require_shallow(text: str, locate: Locate) -> None:
    """Raises SceneError where `text` is nested so deep that composing it might end the process."""
    depth = 0
    for event in yaml.parse(text, Loader=LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise SceneError(f"{_place(locate, event.start_mark)}: {TOO_DEEP}")


def _place(locate: Locate, mark: Any) -> str:
    """Where a `mark` of PyYAML is, the beginning where there is none."""
    return locate(mark.line + 1, mark.column + 1) if mark else locate(1, 1)


class _Builder:
    """Makes nodes of those of PyYAML; what an alias stands for is copied, and `count` of nodes."""

    def __init__(self, locate: Locate, problems: Problems):
        self.locate, self.problems = locate, problems
        self.count = 0

    def build(self, source: yaml.Node, key: str, key_where: str | None, depth: int) -> Node:
        """The node at `key` for `source`, within so many others."""
        where = self.where(source)
        node = Node(key, where, key_where or where, None)
        self.count += 1
        if depth > MAX_DEPTH:
            raise node.refused(TOO_DEEP)
        if self.count > MAX_NODES:
            raise node.refused(f"holds more than {MAX_NODES:,} values, those of aliases counted")
        if source.tag not in TAGS:
            raise node.refused(f"tags such as {source.tag!r} are not supported")
        if isinstance(source, yaml.ScalarNode):
            node.value = source.value if source.style else resolve(source.value)
        elif isinstance(source, yaml.SequenceNode):
            node.value = [
                self.build(entry, node.child_key(index), None, depth + 1)
                for index, entry in enumerate(source.value)
            ]
        else:
            node.value = self.entries(source, node, depth)
        return node

    def entries(self, source: yaml.Node, parent: Node, depth: int) -> dict[str, Node]:
        entries = dict[str, Node]()
        for named, value in source.value:
            where = self.where(named)
            if not isinstance(named, yaml.ScalarNode):
                raise SceneError(f"{where}: {parent.child_key('?')}: a key must be plain text")
            name = named.value if named.value.isprintable() else repr(named.value)
            child = self.build(value, parent.child_key(name), where, depth + 1)
            if name in entries:
                place = entries[name].key_where
                self.problems.note(child.key_refused(f"repeated key; it is already at {place}"))
            else:
                entries[name] = child
        return entries

    def where(self, source: yaml.Node) -> str:
        return _place(self.locate, source.start_mark)


_WORDS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), math.inf),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), -math.inf),
}
_NUMBERS: Mapping[str, Callable[[str], Scalar]] = {
    r"[-+]?[0-9]{1,30}": int,
    r"0x[0-9a-fA-F]{1,30}": lambda text: int(text, 16),
    r"0o[0-7]{1,30}": lambda text: int(text, 8),
    r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?": float,
}


def resolve(text: str) -> Scalar:
    """The value of the unquoted scalar `text`."""
    if text in _WORDS:
        return _WORDS[text]
    read = next((read for form, read in _NUMBERS.items() if re.fullmatch(form, text)), str)
    return read(text)
