"""YAML text as a tree of nodes that know their key path and where they were written.

The strict part of YAML: one document of mappings, lists and scalars, no tags, aliases or repeated
keys. Plain scalars mean what the core schema of YAML 1.2 (section 10.3.2) says, without octal and
hexadecimal numbers: `1e-3` is a number, `yes` is text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ddrecon.errors import Problems, SceneError

Scalar = None | bool | int | float | str

MAX_DEPTH = 32
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

    def refused(self, fault: str) -> SceneError:
        """The error that says what is wrong with this value."""
        return SceneError(": ".join(filter(None, (self.where, self.key, fault))))

    def key_refused(self, fault: str) -> SceneError:
        """The error that says what is wrong with the key of this value."""
        return SceneError(f"{self.key_where}: {self.key}: {fault}")

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
        _require_strict(text, locate)
        root = yaml.compose(text, Loader=LOADER)
    except yaml.MarkedYAMLError as error:
        where = _place(locate, error.problem_mark or error.context_mark)
        fault = ", ".join(filter(None, (error.context, error.problem)))
    except UnicodeEncodeError:
        where, fault = locate(1, 1), "its text is not UTF-8"
    except yaml.reader.ReaderError as error:
        before = text.encode(errors="replace")[: error.position].decode(errors="ignore")
        where = locate(before.count("\n") + 1, len(before) - before.rfind("\n"))
        fault = f"the character {error.character!r} is not allowed"
    else:
        if root is None:
            raise SceneError(f"{locate(1, 1)}: is empty")
        return _node_of(root, locate, problems, key)
    raise SceneError(f"{where}: not YAML: {fault}")


def _place(locate: Locate, mark: Any) -> str:
    """Where a `mark` of PyYAML is, the beginning where there is none."""
    return locate(mark.line + 1, mark.column + 1) if mark else locate(1, 1)


def _require_strict(text: str, locate: Locate) -> None:
    """Raises SceneError for aliases, tags and deep nesting, before anything recurses into them."""
    depth = 0
    for event in yaml.parse(text, Loader=LOADER):
        fault = ""
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            fault = "aliases such as *name are not supported; write the value again"
        elif tag := getattr(event, "tag", None):
            fault = f"tags such as {tag!r} are not supported"
        elif depth > MAX_DEPTH:
            fault = f"nested more than {MAX_DEPTH} deep"
        if fault:
            raise SceneError(f"{_place(locate, event.start_mark)}: {fault}")


def _node_of(
    yaml_node: Any, locate: Locate, problems: Problems, key: str, key_where: str = ""
) -> Node:
    where = _place(locate, yaml_node.start_mark)
    node = Node(key, where, key_where or where, None)
    if isinstance(yaml_node, yaml.ScalarNode):
        node.value = yaml_node.value if yaml_node.style else resolve(yaml_node.value)
    elif isinstance(yaml_node, yaml.SequenceNode):
        node.value = [
            _node_of(entry, locate, problems, node.child_key(index))
            for index, entry in enumerate(yaml_node.value)
        ]
    else:
        entries = node.value = dict[str, Node]()
        for name_node, value in yaml_node.value:
            name, place = name_node.value, _place(locate, name_node.start_mark)
            if not isinstance(name_node, yaml.ScalarNode):
                raise SceneError(f"{place}: {node.child_key('?')}: a key must be plain text")
            if not name or not name.isprintable():
                name = repr(name)
            child = _node_of(value, locate, problems, node.child_key(name), place)
            if first := entries.get(name):
                fault = f"repeated key; it is already at {first.key_where}"
                problems.note(child.key_refused(fault))
            entries.setdefault(name, child)
    return node


_WORDS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), math.inf),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), -math.inf),
}


def resolve(text: str) -> Scalar:
    """The value of the unquoted scalar `text`."""
    if text in _WORDS:
        return _WORDS[text]
    if re.fullmatch(r"[-+]?[0-9]{1,30}", text):
        return int(text)
    is_number = re.fullmatch(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", text)
    return float(text) if is_number else text
