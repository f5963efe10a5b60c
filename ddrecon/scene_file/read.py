"""YAML text as a tree of nodes that know where they were written, and their values by types.

The strict part of YAML: one document of mappings, lists and scalars, no tags, aliases or repeated
keys. Plain scalars mean what the core schema of YAML 1.2 (section 10.3.2) says, without octal and
hexadecimal numbers: `1e-3` is a number, `yes` is text.

A type may have alternatives: the kind of a node, a mapping, list, text or number, tells which of
them it is. Records are told apart by their `type`, others by their first required key.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, fields, is_dataclass
from functools import partial, reduce
from operator import or_
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_origin

import yaml

from ddrecon.errors import Problems, SceneError, gather, nearest, suggestion
from ddrecon.records import WORDS, alternatives, find_excess, is_required, type_hints
from ddrecon.settings import FieldFile

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


R = TypeVar("R")

LARGEST = 3e38
"""The largest magnitude that single precision holds, roughly."""
PLURALS = {"number": "numbers", "whole number": "whole numbers", "list of 4 numbers": "rows of 4"}


class Rule(NamedTuple):
    """What a value must be: of the type `hint`, within `limits`; relative paths start at `folder`.

    `finish[key](node, value, folder)` is what the value at `key` stands for.
    """

    hint: Any
    folder: Path
    limits: Mapping[str, Any]
    finish: Mapping[str, Callable[[Node, Any, Path], Any]]

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types of which a value may be."""
        return alternatives(self.hint)

    @property
    def choices(self) -> tuple[Any, ...]:
        """The values that are legal, where the limits name them."""
        return self.limits.get("choices", ()) if {str, int} & set(self.kinds) else ()


def read_as(node: Node, hint: Any, folder: Path = Path(), **limits: float) -> Any:
    """The value of `node`, of the type `hint` within `limits`."""
    return read_value(node, Rule(hint, folder, limits, {}))


def describe_type(hint: Any) -> str:
    """What a value of the type `hint` is, in words."""
    kinds = [kind for kind in alternatives(hint) if kind is not NoneType]
    words = list(dict.fromkeys(_describe(kind, kinds) for kind in kinds))
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def _describe(kind: Any, kinds: Sequence[Any]) -> str:
    arguments = get_args(kind)
    if get_origin(kind) is Literal:
        return " or ".join(arguments)
    if get_origin(kind) is tuple:
        if float in kinds and arguments == (float, float, float):
            return "[r, g, b]"
        if arguments[-1] is Ellipsis and arguments[0] is not float:
            return "a list with at least one entry"
        inner = describe_type(arguments[0]).removeprefix("a ")
        count = "" if arguments[-1] is Ellipsis else f"{len(arguments)} "
        return f"a list of {count}{PLURALS.get(inner, inner)}"
    if is_dataclass(kind) and float in kinds:
        return f"{{{fields(kind)[0].name}: ...}}"
    return "a file" if kind is Path else WORDS.get(kind, "a mapping")


def read_value(node: Node, rule: Rule) -> Any:
    """The value of `node` by `rule`; raises SceneError with everything wrong in it."""
    rule = rule._replace(folder=node.folder or rule.folder)
    match node.value:
        case dict():
            value = _read_mapping(node, rule)
        case list():
            value = _read_list(node, rule)
        case str():
            value = _read_text(node, rule)
        case _:
            value = _read_plain(node, rule)
    return rule.finish[node.key](node, value, rule.folder) if node.key in rule.finish else value


def _refused(node: Node, rule: Rule) -> Exception:
    choices = [str(choice) for choice in rule.choices]
    expected = f"one of {', '.join(choices)}" if choices else describe_type(rule.hint)
    description = describe_found(node)
    if isinstance(node.value, str):
        description += nearest(node.value, choices)
    elif isinstance(node.value, int | float) and {str, Path} & set(rule.kinds) and not choices:
        description += " (put it in quotes)"
    return node.refused(f"expected {expected}, found {description}")


def _read_plain(node: Node, rule: Rule) -> float | None:
    """A number, true or false, or nothing."""
    value, kinds = node.value, rule.kinds
    if value is None or isinstance(value, bool):
        if type(value) in kinds:
            return value
        raise _refused(node, rule)
    assert isinstance(value, int | float)
    is_whole = isinstance(value, int) and int in kinds
    if not is_whole and float not in kinds:
        raise _refused(node, rule)
    if not -LARGEST <= value <= LARGEST:
        expected = "expected a finite number of single precision"
        raise node.refused(f"{expected}, found {describe_found(node)}")
    if rule.choices and value not in rule.choices:
        raise _refused(node, rule)
    if fault := find_excess(value, rule.limits):
        raise node.refused(fault)
    return value if is_whole else float(value)


def _read_text(node: Node, rule: Rule) -> str | Path:
    """Text, one of the choices where there are such, or the path of a file, made absolute."""
    words = [word for kind in rule.kinds if get_origin(kind) is Literal for word in get_args(kind)]
    if not words and not {str, Path} & set(rule.kinds):
        raise _refused(node, rule)
    text = str(node.value)
    if not text or not text.isprintable():
        raise node.refused(f"expected text that can be printed, found {describe_found(node)}")
    if Path in rule.kinds:
        return path_in(rule.folder, text)
    if (choices := words or rule.choices) and text not in choices:
        raise _refused(node, rule)
    return text


def path_in(folder: Path, text: str) -> Path:
    """The absolute path that `text` is in `folder`.

    Backslashes are separators, as Windows writes them, unless a name that is there has them.
    """
    is_there = "\\" not in text or os.path.exists(folder / text)
    return (folder / (text if is_there else text.replace("\\", "/"))).absolute()


def _read_list(node: Node, rule: Rule) -> Any:
    """As many entries as the tuple among `kinds` has, or any number.

    Of others than numbers that is at least one, unless the field `may_be_empty`.
    """
    entries = node.children()
    for arguments in (get_args(kind) for kind in rule.kinds if get_origin(kind) is tuple):
        may_be_empty = arguments[0] is float or rule.limits.get("may_be_empty")
        is_open = arguments[-1] is Ellipsis and (entries or may_be_empty)
        if is_open or len(entries) == len(arguments):
            values = gather(partial(read_value, rule=rule._replace(hint=arguments[0])), entries)
            if rule.limits.get("is_nonzero") and not any(values):
                raise node.refused("must not be zero")
            return tuple(values)
    raise _refused(node, rule)


def _read_mapping(node: Node, rule: Rule) -> Any:
    """A record, or a mapping of names to records; `{constant: number}` stands for the number."""
    entries, kinds = node.entries(), rule.kinds
    if FieldFile in kinds and float in kinds and set(entries) == {"constant"}:
        return read_value(entries["constant"], rule._replace(hint=float))
    if records := [kind for kind in kinds if is_dataclass(kind)]:
        return read_record(node, _pick(node, records, rule), rule)
    for kind in kinds:
        if get_origin(kind) is Mapping:
            read = partial(read_value, rule=rule._replace(hint=get_args(kind)[1]))
            values = gather(read, node.children())
            return dict(zip(entries, values, strict=True))
    raise _refused(node, rule)


def _pick(node: Node, kinds: Sequence[Any], rule: Rule) -> Any:
    """That of `kinds` which the mapping `node` is, by its `type` or first required key."""
    entries = node.entries()
    if not (tagged := {kind.type: kind for kind in kinds if hasattr(kind, "type")}):
        needs = [(kind, [key.name for key in fields(kind) if is_required(key)]) for kind in kinds]
        named = {kind: name for kind, names in needs for name in names if name in entries}
        if len(named) > 1:
            raise node.refused(f"give only one of {' or '.join(named.values())}")
        return next(iter(named), kinds[0])
    if "type" not in entries:
        raise node.refused(f"missing key 'type', one of {', '.join(tagged)}")
    limits = {**rule.limits, "choices": tuple(tagged)}
    return tagged[read_value(entries["type"], rule._replace(hint=str, limits=limits))]


def read_record(node: Node, kind: type[R], rule: Rule) -> R:
    """The record of type `kind` that `node` describes; raises SceneError with all that is wrong."""
    entries, hints = node.entries(), type_hints(kind)
    declared = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    known = [*(["type"] if hasattr(kind, "type") else []), *declared]
    problems, values = Problems(), {}
    for fault in _absences(declared, getattr(kind, "ALTERNATIVES", ()), entries):
        problems.note(node.refused(fault))
    for name, child in entries.items():
        with problems.collecting():
            if name not in known:
                raise child.key_refused(f"unknown key{suggestion(name, known)}")
            if name in declared:
                limits = declared[name].metadata
                hint = reduce(or_, limits.get("also", ()), hints[name])
                values[name] = read_value(child, rule._replace(hint=hint, limits=limits))
        if problems.are_many:
            break
    problems.raise_any()
    record = kind(**values)
    for name, fault in getattr(record, "violations", tuple)():
        problems.note(entries.get(name, node).refused(fault))
    problems.raise_any()
    return record


def _absences(
    declared: Mapping[str, Field[Any]],
    groups: Sequence[tuple[str, ...]],
    entries: Mapping[str, Node],
) -> list[str]:
    """What is wrong with the set of keys: required ones and one of the alternative `groups`.

    Of a group, what has no default is required with it.
    """
    present = {name for name, entry in entries.items() if entry.value is not None}
    needed = [[name for name in group if declared[name].default is None] for group in groups]
    chosen = [names for group, names in zip(groups, needed, strict=True) if present & set(group)]
    absent = [name for name, key in declared.items() if is_required(key) and name not in entries]
    if len(chosen) == 1:
        absent += [name for name in chosen[0] if name not in present]
    faults = [f"missing key {name!r}" for name in absent]
    if groups and len(chosen) != 1:
        words = " or ".join(" and ".join(names) for names in needed)
        faults.append(f"{'give only one of' if chosen else 'missing'} {words}")
    return faults
