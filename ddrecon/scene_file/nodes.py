"""YAML text as a tree of nodes that know their key path and where they were written.

The strict part of YAML: one document of mappings, lists and scalars; no tags or repeated keys.
Aliases, and the merge key `<<`, are written out, up to `MAX_COPIES` values. What plain scalars mean
is the core schema of YAML 1.2 (section 10.3.2): `1e-3` is a number, `yes` is text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import yaml

from ddrecon.errors import SceneError
from ddrecon.scene_file.problems import Problems

Scalar = None | bool | int | float | str

MAX_DEPTH = 32
MAX_COPIES = 10_000
"""So many values may come of aliases: a few of these could stand for billions."""
MERGE = "<<"
FAST = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""The parser in C, where it is there: some twenty times faster."""
SHORT = 2**17
"""What the parser in C refuses the other one looks at, if it has no more characters: its messages
are better, and it takes all of JSON.
"""

Locate = Callable[[int, int], str]
"""Tells where a 1-based line and column are: `file:line:column`, or the override they belong to."""


@dataclass
class Node:
    """A value at the dotted path `key`, written at `where` (its key at `key_where`)."""

    key: str
    where: str
    key_where: str
    value: Scalar | list[Node] | dict[str, Node]

    def refused(self, what: str) -> SceneError:
        """The error that says `what` is wrong with this value."""
        return SceneError(
            f"{self.where}: {self.key}: {what}" if self.key else f"{self.where}: {what}"
        )

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
    return show_value(node.value)


def show_value(value: Scalar) -> str:
    """`value` in one short line."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def parse(text: str, locate: Locate, problems: Problems, key: str = "") -> Node:
    """The tree of the YAML (or JSON) document `text`, whose root is at `key`.

    Repeated keys go to `problems`.

    Raises SceneError where the text has no such tree: broken syntax, several documents, tags.
    """
    try:
        return _parse(text, locate, problems, key)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = locate(mark.line + 1, mark.column + 1) if mark else locate(1, 1)
        raise SceneError(
            f"{where}: not YAML: {', '.join(filter(None, (error.context, error.problem)))}"
        ) from error
    except UnicodeEncodeError as error:
        raise SceneError(f"{locate(1, 1)}: is not UTF-8 text") from error
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        where = locate(before.count("\n") + 1, len(before) - before.rfind("\n"))
        raise SceneError(
            f"{where}: not YAML: the character {error.character!r} is not allowed"
        ) from error


def _parse(text: str, locate: Locate, problems: Problems, key: str) -> Node:
    """The tree as the parser in C sees it, or the other one where that refuses a short text."""
    repeated = Problems()
    try:
        root = _Composer(text, locate, repeated, FAST).document(key)
    except (yaml.YAMLError, UnicodeEncodeError):
        if len(text) > SHORT:
            raise
        return _Composer(text, locate, problems, yaml.BaseLoader).document(key)
    problems.lines.extend(repeated.lines)
    return root


class _Composer:
    """Builds nodes from the parser's events: aliases are seen before anything follows them.

    `anchors` are the nodes that aliases may stand for, by name; `copies` counts what they became.
    """

    def __init__(self, text: str, locate: Locate, problems: Problems, loader: Any):
        self.events = yaml.parse(text, Loader=loader)
        self.locate, self.problems = locate, problems
        self.anchors: dict[str, Node] = {}
        self.copies = 0

    def document(self, key: str) -> Node:
        next(self.events)
        if isinstance(next(self.events), yaml.StreamEndEvent):
            raise SceneError(f"{self.locate(1, 1)}: is empty")
        root = self.node(next(self.events), key, None, 0)
        next(self.events)
        after = next(self.events)
        if not isinstance(after, yaml.StreamEndEvent):
            raise SceneError(
                f"{self.where(after)}: a second document begins here; only one is allowed"
            )
        return root

    def node(self, event: yaml.Event, key: str, key_where: str | None, depth: int) -> Node:
        where = self.where(event)
        node = Node(key, where, key_where or where, None)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                raise node.refused(f"*{event.anchor} stands for nothing: no &{event.anchor} before")
            return self.copy(self.anchors[event.anchor], node, node, depth)
        if tag := getattr(event, "tag", None):
            raise node.refused(f"tags such as {tag!r} are not supported")
        if depth > MAX_DEPTH:
            raise node.refused(f"nested more than {MAX_DEPTH} deep")
        if isinstance(event, yaml.ScalarEvent):
            node.value = resolve(event.value) if not event.style else _join(event.value)
        elif isinstance(event, yaml.SequenceStartEvent):
            node.value = list(self.items(node, depth))
        else:
            node.value = self.mapping(node, depth)
        if anchor := getattr(event, "anchor", None):
            self.anchors[anchor] = node
        return node

    def copy(self, source: Node, place: Node, alias: Node, depth: int) -> Node:
        """`source` with all that is below it, for the `place` that an `alias` leads to."""
        self.copies += 1
        if self.copies > MAX_COPIES:
            raise alias.refused(
                f"aliases stand for more than {MAX_COPIES:,} values; write the value out"
            )
        if depth > MAX_DEPTH:
            raise alias.refused(f"nested more than {MAX_DEPTH} deep")

        def below(name: object, child: Node) -> Node:
            inner = Node(place.child_key(name), child.where, child.key_where, None)
            return self.copy(child, inner, alias, depth + 1)

        value = source.value
        if isinstance(value, dict):
            value = {name: below(name, child) for name, child in value.items()}
        elif isinstance(value, list):
            value = [below(index, child) for index, child in enumerate(value)]
        return Node(place.key, place.where, place.key_where, value)

    def items(self, parent: Node, depth: int) -> Iterator[Node]:
        index = 0
        while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
            yield self.node(event, parent.child_key(index), None, depth + 1)
            index += 1

    def mapping(self, parent: Node, depth: int) -> dict[str, Node]:
        entries, merged = dict[str, Node](), dict[str, Node]()
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                raise SceneError(
                    f"{self.where(event)}: {parent.child_key('?')}: a key must be plain text"
                )
            if event.value == MERGE and not event.style:
                merged = self.merged(parent, self.where(event), depth) | merged
                continue
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
        return merged | entries

    def merged(self, parent: Node, where: str, depth: int) -> dict[str, Node]:
        """The entries of the mapping that follows a merge key in `parent`."""
        child = self.node(next(self.events), parent.key, where, depth)
        if not isinstance(child.value, dict):
            raise child.key_refused(
                f"{MERGE} takes the entries of one mapping, found {describe_found(child)}"
            )
        return child.value

    def where(self, event: yaml.Event) -> str:
        mark = event.start_mark
        return self.locate(mark.line + 1, mark.column + 1) if mark else self.locate(1, 1)


def _join(text: str) -> str:
    r"""`text` with the surrogate pairs that JSON writes as \ud83d\ude00 made one character each."""
    return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


_WORDS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan),
    **{
        sign + word: float(sign + "inf")
        for sign in ("", "+", "-")
        for word in (".inf", ".Inf", ".INF")
    },
}
_INTEGER = re.compile(r"[-+]?[0-9]{1,30}")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]{1,30}")
_OCTAL = re.compile(r"0o[0-7]{1,30}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def resolve(text: str) -> Scalar:
    """The value of the unquoted scalar `text`."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _HEXADECIMAL.fullmatch(text):
        return int(text, 16)
    if _OCTAL.fullmatch(text):
        return int(text, 8)
    return float(text) if _FLOAT.fullmatch(text) else text
