"""YAML text as a tree of nodes that know their key path and where they were written.

The strict part of YAML: one document of mappings, lists and scalars; no tags or repeated keys.
Aliases are written out, up to `MAX_COPIES` values. What plain scalars mean is the core schema of
YAML 1.2 (section 10.3.2), which has no merge key `<<`: `1e-3` is a number, `yes` is text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

from ddrecon.errors import Problems, SceneError

Scalar = None | bool | int | float | str

MAX_DEPTH = 32
MAX_COPIES = 10_000
"""So many values may come of aliases: a few of these could stand for billions."""
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
        return _Composer(text, locate, problems).document(key)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = locate(mark.line + 1, mark.column + 1) if mark else locate(1, 1)
        what = ", ".join(filter(None, (error.context, error.problem)))
    except UnicodeEncodeError:
        where, what = locate(1, 1), "its text is not UTF-8"
    except yaml.reader.ReaderError as error:
        before = text.encode(errors="replace")[: error.position].decode(errors="ignore")
        where = locate(before.count("\n") + 1, len(before) - before.rfind("\n"))
        what = f"the character {error.character!r} is not allowed"
    raise SceneError(f"{where}: not YAML: {what}")


class _Composer:
    """Builds nodes from the parser's events: aliases are seen before anything follows them.

    `anchors` are the nodes that aliases may stand for, by name; `copies` counts what they became.
    """

    def __init__(self, text: str, locate: Locate, problems: Problems):
        self.events = yaml.parse(text, Loader=LOADER)
        self.locate, self.problems = locate, problems
        self.anchors: dict[str, Node] = {}
        self.copies = 0

    def document(self, key: str) -> Node:
        next(self.events)
        if isinstance(next(self.events), yaml.StreamEndEvent):
            raise SceneError(f"{self.locate(1, 1)}: is empty")
        root = self.node(next(self.events), key, None, 0)
        next(self.events)
        if not isinstance(after := next(self.events), yaml.StreamEndEvent):
            raise SceneError(f"{self.where(after)}: a second document begins; only one is allowed")
        return root

    def node(self, event: yaml.Event, key: str, key_where: str | None, depth: int) -> Node:
        where = self.where(event)
        node = Node(key, where, key_where or where, None)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                raise node.refused(f"*{event.anchor} stands for nothing: no &{event.anchor} before")
            return self.copy(self.anchors[event.anchor], node, depth)
        tag, anchor = getattr(event, "tag", None), getattr(event, "anchor", None)
        if tag:
            raise node.refused(f"tags such as {tag!r} are not supported")
        if depth > MAX_DEPTH:
            raise node.refused(f"nested more than {MAX_DEPTH} deep")
        if isinstance(event, yaml.ScalarEvent):
            node.value = event.value if event.style else resolve(event.value)
        elif isinstance(event, yaml.SequenceStartEvent):
            node.value = entries = list[Node]()
            while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
                entries.append(self.node(event, node.child_key(len(entries)), None, depth + 1))
        else:
            node.value = self.mapping(node, depth)
        if anchor:
            self.anchors[anchor] = node
        return node

    def copy(self, source: Node, node: Node, depth: int) -> Node:
        """`node`, an alias of `source` or below one, with copies of all that is below `source`."""
        self.copies += 1
        if self.copies > MAX_COPIES or depth > MAX_DEPTH:
            raise node.refused(
                f"aliases stand for more than {MAX_COPIES:,} values, or are nested more than"
                f" {MAX_DEPTH} deep; write the value out"
            )

        def below(name: object, child: Node) -> Node:
            place = Node(node.child_key(name), child.where, child.key_where, None)
            return self.copy(child, place, depth + 1)

        if isinstance(source.value, dict):
            node.value = {name: below(name, child) for name, child in source.value.items()}
        elif isinstance(source.value, list):
            node.value = [below(index, child) for index, child in enumerate(source.value)]
        else:
            node.value = source.value
        return node

    def mapping(self, parent: Node, depth: int) -> dict[str, Node]:
        entries = dict[str, Node]()
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                raise SceneError(
                    f"{self.where(event)}: {parent.child_key('?')}: a key must be plain text"
                )
            name = event.value if event.value.isprintable() else repr(event.value)
            child = self.node(
                next(self.events), parent.child_key(name), self.where(event), depth + 1
            )
            if name in entries:
                self.problems.note(
                    child.key_refused(f"repeated key; it is already at {entries[name].key_where}")
                )
            else:
                entries[name] = child
        return entries

    def where(self, event: yaml.Event) -> str:
        mark = event.start_mark
        return self.locate(mark.line + 1, mark.column + 1) if mark else self.locate(1, 1)


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
