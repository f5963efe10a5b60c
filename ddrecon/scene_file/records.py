"""Reading records: any frozen dataclass of the schema from a mapping, by its fields' types.

There is one function per shape of type; `Node`s are those of the YAML.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import cache, reduce
from operator import or_
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from ddrecon.scene_file.absences import find_absences
from ddrecon.scene_file.colmap import read_colmap
from ddrecon.scene_file.leaves import (
    LEAVES,
    Rule,
    read_color,
    read_each,
    read_list,
    read_number,
    read_text,
)
from ddrecon.scene_file.nodes import Node, describe_found
from ddrecon.scene_file.problems import Problems, suggestion
from ddrecon.scene_file.ring import ring_views
from ddrecon.scene_file.schema import (
    AnyVolume,
    Constant,
    Density,
    MediumSection,
    MixtureSection,
    Quantity,
    ViewSection,
    ViewSource,
    VolumeSection,
)
from ddrecon.scene_file.transforms import read_transforms
from ddrecon.settings import (
    FieldFile,
    ParameterSettings,
    Start,
)
from ddrecon.variables.kinds import (
    CROSS_SECTIONS,
    EXTINCTION_AND_ALBEDO,
    KINDS,
    Kind,
    kind_of,
    pattern_of,
    split_name,
)

R = TypeVar("R")
type_hints: Callable[[type], dict[str, Any]] = cache(get_type_hints)


def read_record(node: Node, kind: type[R], folder: Path) -> R:
    """The record of type `kind` that the mapping `node` describes.

    Raises SceneError with everything wrong in it.
    """
    entries = _mapping(node)
    all_fields = fields(kind)  # type: ignore[arg-type]
    declared: dict[str, Field[Any]] = {field.name: field for field in all_fields}
    known = [*(["type"] if hasattr(kind, "type") else []), *declared]
    hints, problems, values = type_hints(kind), Problems(), {}
    for what in find_absences(kind, declared, entries):
        problems.note(node.refused(what))
    for name, child in entries.items():
        with problems.collecting():
            if name not in known:
                retired = getattr(kind, "RETIRED", {}).get(name)
                raise child.key_refused(retired or f"unknown key{suggestion(name, known)}")
            if name in declared:
                values[name] = read_value(child, Rule(hints[name], declared[name].metadata, folder))
        if problems.are_many:
            break
    problems.raise_any()
    return _require_rules(node, kind(**values))


def read_value(node: Node, rule: Rule) -> Any:
    """The value of `node` by `rule`.

    It is a leaf, a record, a list of records, or one of several records told apart by `type`.
    """
    if read := READERS.get(rule.hint):
        return read(node, rule)
    arguments = get_args(rule.hint)
    if type(None) in arguments:
        if node.value is None:
            return None
        hint = reduce(or_, (argument for argument in arguments if argument is not type(None)))
        return read_value(node, Rule(hint, rule.limits, rule.folder))
    if is_dataclass(rule.hint):
        return read_record(node, rule.hint, rule.folder)  # type: ignore[arg-type]
    if get_origin(rule.hint) is tuple:
        return read_each(read_list(node), Rule(arguments[0], rule.limits, rule.folder), read_value)
    return _read_tagged(node, {kind.type: kind for kind in arguments}, rule.folder)


def _mapping(node: Node) -> dict[str, Node]:
    """The entries of `node`; raises SceneError where it is no mapping."""
    if not isinstance(node.value, dict):
        raise node.refused(f"expected a mapping, found {describe_found(node)}")
    return node.value


def _require_rules(node: Node, record: R) -> R:
    """`record`, unless it breaks a rule about several of its values."""
    problems = Problems()
    for name, what in getattr(record, "problems", tuple)():
        problems.note(_mapping(node).get(name, node).refused(what))
    problems.raise_any()
    return record


def _read_tagged(node: Node, kinds: Mapping[str, type], folder: Path) -> Any:
    """A record of the one of `kinds` that the entry `type` names."""
    entries = _mapping(node)
    if "type" not in entries:
        raise node.refused(f"missing key 'type', one of {', '.join(kinds)}")
    name = read_text(entries["type"], Rule(str, {"choices": tuple(kinds)}, folder))
    return read_record(node, kinds[name], folder)


def _read_density(node: Node, rule: Rule) -> float | FieldFile:
    """A number, `{constant: number}` or `{file: path}`."""
    if isinstance(node.value, dict) and "file" in node.value:
        return read_record(node, FieldFile, rule.folder)
    if isinstance(node.value, dict) and "constant" in node.value:
        return read_record(node, Constant, rule.folder).constant
    if node.value is None or isinstance(node.value, str | list | dict):
        raise node.refused(
            "expected a number, {constant: number} or {file: path},"
            f" found {describe_found(node)}"
        )
    return read_number(node, rule)


def _read_quantity(node: Node, rule: Rule) -> Any:
    """A number, a color or `{file: path}`."""
    return (
        read_record(node, FieldFile, rule.folder)
        if isinstance(node.value, dict)
        else read_color(node, rule)
    )


def _read_volume(node: Node, rule: Rule) -> VolumeSection | MixtureSection:
    """A volume of one medium, or of two where it has `media`."""
    if "media" in _mapping(node):
        return read_record(node, MixtureSection, rule.folder)
    return read_record(node, VolumeSection, rule.folder)


def _read_media(node: Node, rule: Rule) -> dict[str, MediumSection]:
    """Media by name."""
    names, nodes = zip(*_mapping(node).items(), strict=True) if node.value else ((), ())
    media = read_each(nodes, Rule(MediumSection, {}, rule.folder), read_value)
    return dict(zip(names, media, strict=True))


def _read_parameters(node: Node, rule: Rule) -> dict[str, ParameterSettings]:
    """Settings by name of a variable, of one pair of cross sections at most."""
    problems, parameters = Problems(), {}
    for name, child in _mapping(node).items():
        with problems.collecting():
            if pattern_of(name) not in KINDS:
                raise child.key_refused(f"unknown parameter{suggestion(pattern_of(name), KINDS)}")
            settings = read_record(child, ParameterSettings, rule.folder)
            if settings.support is not None and name != "density":
                support = _mapping(child)["support"]
                raise support.refused(f"{describe_found(support)} is for density alone")
            parameters[name] = _require_legal(child, settings, kind_of(name))
    problems.raise_any()
    if not parameters:
        raise node.refused(f"names no parameter; known: {', '.join(KINDS)}")
    for name in parameters:
        medium, last = split_name(name)
        others = [medium + other for other in CROSS_SECTIONS if medium + other in parameters]
        if last in EXTINCTION_AND_ALBEDO and others:
            raise _mapping(node)[name].key_refused(
                f"cannot be optimized beside {others[0]}:"
                " take sigma_a and sigma_s, or sigma_t and albedo"
            )
    return parameters


def _require_legal(node: Node, settings: ParameterSettings, kind: Kind) -> ParameterSettings:
    """`settings`, unless they leave what is legal for a parameter of `kind`."""
    problems = Problems()
    numbers = {"min": settings.min, "max": settings.max} | {
        "init": settings.init if isinstance(settings.init, float) else None
    }
    for name, number in numbers.items():
        if number is not None and not kind.low <= number <= kind.high:
            problems.note(
                _mapping(node)[name].refused(
                    f"must be at least {kind.low:g} and at most {kind.high:g}, found {number:g}"
                )
            )
    if isinstance(settings.init, tuple) and not all(
        kind.low <= entry <= kind.high for entry in settings.init
    ):
        problems.note(
            _mapping(node)["init"].refused(
                f"each entry must be at least {kind.low:g} and at most {kind.high:g}"
            )
        )
    if not kind.is_cellwise:
        for name in ("field", "tv"):
            if getattr(settings, name):
                problems.note(_mapping(node)[name].refused("it is not a field, so it has none"))
    problems.raise_any()
    return settings


def _read_start(node: Node, rule: Rule) -> Any:
    """A number, a list of numbers or `{file: path}`."""
    return (
        read_each(read_list(node), rule, read_number)
        if isinstance(node.value, list)
        else _read_density(node, rule)
    )


def _read_views(node: Node, rule: Rule) -> tuple[ViewSection, ...]:
    """A list of views with names of their own, or the views of a ring or of transforms."""
    if isinstance(node.value, dict):
        source = read_record(node, ViewSource, rule.folder)
        if source.ring is not None:
            return ring_views(node, source.ring, source.images, rule.folder)
        if source.colmap is not None:
            images = (rule.folder / (source.images or "")).absolute()
            return read_colmap(node.value["colmap"], source.colmap, images, source.test_every)
        return read_transforms(node.value["transforms"], source.transforms or (), source.test_every)
    entries = read_list(node)
    for index, entry in enumerate(entries):
        if isinstance(entry.value, dict):
            entry.value.setdefault(
                "name", Node(entry.child_key("name"), entry.where, entry.where, f"view_{index:02d}")
            )
    views = read_each(entries, Rule(ViewSection, {}, rule.folder), read_value)
    _require_unique(entries, [view.name for view in views])
    return views


def _require_unique(entries: list[Node], names: list[str]) -> None:
    problems, first = Problems(), dict[str, int]()
    for index, (entry, name) in enumerate(zip(entries, names, strict=True)):
        if first.setdefault(name, index) != index:
            problems.note(
                _mapping(entry)["name"].refused(
                    f"{name!r} is already the name of view {first[name]}"
                )
            )
    problems.raise_any()


READERS: dict[Any, Callable[[Node, Rule], Any]] = {
    **LEAVES,
    AnyVolume: _read_volume,
    Mapping[str, MediumSection]: _read_media,
    Density: _read_density,
    Quantity: _read_quantity,
    Start: _read_start,
    Mapping[str, ParameterSettings]: _read_parameters,
    tuple[ViewSection, ...]: _read_views,
}
