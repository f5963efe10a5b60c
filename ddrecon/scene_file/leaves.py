"""Reading the leaves of a scene: numbers, text, paths, vectors and colors.

Each must be within the limits that its record declares.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ddrecon.grid import Triple
from ddrecon.scene_file.camera_schema import Matrix, Pair, Row, Size
from ddrecon.scene_file.light_schema import Color
from ddrecon.scene_file.nodes import Node, describe_found, show_value
from ddrecon.scene_file.problems import Problems, suggestion
from ddrecon.scene_file.schema import Backdrop, Count, Paths
from ddrecon.settings import AUTO, Iterations

T = TypeVar("T")

LARGEST = 3e38
"""The largest magnitude that single precision holds, roughly."""

LIMITS: dict[str, tuple[str, Callable[[float, float], bool]]] = {
    "minimum": ("at least", operator.ge),
    "above": ("above", operator.gt),
    "maximum": ("at most", operator.le),
    "below": ("below", operator.lt),
}
"""What a bound in a field's metadata means."""


@dataclass(frozen=True)
class Rule:
    """What a value must be: a `hint`, within `limits`; relative paths start at `folder`."""

    hint: Any
    limits: Mapping[str, Any]
    folder: Path


def read_each(nodes: Sequence[Node], rule: Rule, read: Callable[[Node, Rule], T]) -> tuple[T, ...]:
    """What `read` makes of each node; raises SceneError with the problems of all."""
    problems, values = Problems(), []
    for node in nodes:
        with problems.collecting():
            values.append(read(node, rule))
        if problems.are_many:
            break
    problems.raise_any()
    return tuple(values)


def read_list(node: Node) -> list[Node]:
    """The entries of a list that has at least one."""
    if not isinstance(node.value, list) or not node.value:
        raise node.refused(f"expected a list with at least one entry, found {describe_found(node)}")
    return node.value


def read_fraction_list(node: Node, rule: Rule) -> tuple[float, ...]:
    """A list of any number of numbers, also none."""
    if not isinstance(node.value, list):
        raise node.refused(f"expected a list of numbers, found {describe_found(node)}")
    return read_each(node.value, rule, read_number)


def read_bool(node: Node, rule: Rule) -> bool:
    """True or false, and nothing else."""
    if not isinstance(node.value, bool):
        raise node.refused(f"expected true or false, found {describe_found(node)}")
    return node.value


def read_whole(node: Node, rule: Rule) -> int:
    """A whole number."""
    if isinstance(node.value, bool) or not isinstance(node.value, int):
        raise node.refused(f"expected a whole number, found {describe_found(node)}")
    _check_limits(node, node.value, rule.limits)
    choices = rule.limits.get("choices", (node.value,))
    if node.value not in choices:
        raise node.refused(f"expected one of {', '.join(map(str, choices))}, found {node.value}")
    return node.value


def read_number(node: Node, rule: Rule) -> float:
    """A finite number that single precision can hold."""
    if isinstance(node.value, bool) or not isinstance(node.value, int | float):
        raise node.refused(f"expected a number, found {describe_found(node)}")
    if not math.isfinite(node.value) or abs(node.value) > LARGEST:
        raise node.refused(
            f"expected a finite number of single precision, found {describe_found(node)}"
        )
    _check_limits(node, node.value, rule.limits)
    return float(node.value)


def _check_limits(node: Node, value: float, limits: Mapping[str, Any]) -> None:
    for name, (words, is_within) in LIMITS.items():
        if limits.get(name) is not None and not is_within(value, limits[name]):
            raise node.refused(f"must be {words} {limits[name]:g}, found {value:g}")


def read_text(node: Node, rule: Rule) -> str:
    """Text, one of the `choices` where there are such."""
    if not isinstance(node.value, str):
        raise node.refused(f"expected text, found {describe_found(node)}{_quoting(node)}")
    if not node.value or not node.value.isprintable():
        raise node.refused(f"expected text that can be printed, found {describe_found(node)}")
    choices = rule.limits.get("choices")
    if choices is not None and node.value not in choices:
        near = suggestion(node.value, choices) if len(choices) > 1 else ""
        raise node.refused(
            f"expected one of {', '.join(choices)}, found {show_value(node.value)}"
            f"{near if 'did you' in near else ''}"
        )
    return node.value


def _quoting(node: Node) -> str:
    return " (put it in quotes)" if isinstance(node.value, bool | int | float) else ""


def read_path(node: Node, rule: Rule) -> Path:
    """The path of a file, made absolute."""
    return (rule.folder / read_text(node, rule)).absolute()


def read_paths(node: Node, rule: Rule) -> tuple[Path, ...]:
    """One path or a list of them."""
    return (
        read_each(read_list(node), rule, read_path)
        if isinstance(node.value, list)
        else (read_path(node, rule),)
    )


def read_vector(node: Node, rule: Rule) -> tuple[float, ...]:
    """As many numbers as the tuple `rule.hint` has."""
    return read_each(_entries(node, len(rule.hint.__args__), "numbers"), rule, read_number)


def read_counts(node: Node, rule: Rule) -> tuple[int, ...]:
    """As many whole numbers as the tuple `rule.hint` has."""
    return read_each(_entries(node, len(rule.hint.__args__), "whole numbers"), rule, read_whole)


def read_matrix(node: Node, rule: Rule) -> tuple[tuple[float, ...], ...]:
    """Four rows of four numbers."""
    return read_each(
        _entries(node, 4, "rows of 4 numbers"), Rule(Row, rule.limits, rule.folder), read_vector
    )


def read_color(node: Node, rule: Rule) -> float | tuple[float, ...]:
    """One number, or [red, green, blue]."""
    if isinstance(node.value, list):
        return read_vector(node, Rule(Triple, rule.limits, rule.folder))
    if isinstance(node.value, str | dict) or node.value is None:
        raise node.refused(f"expected a number or [r, g, b], found {describe_found(node)}")
    return read_number(node, rule)


def read_backdrop(node: Node, rule: Rule) -> float | tuple[float, ...] | Path:
    """A number, [red, green, blue], or the path of a picture."""
    return read_path(node, rule) if isinstance(node.value, str) else read_color(node, rule)


def read_iterations(node: Node, rule: Rule) -> int | str:
    """A whole number, or `auto`."""
    if isinstance(node.value, str):
        return read_text(node, Rule(str, {"choices": (AUTO,)}, rule.folder))
    return read_whole(node, rule)


def _entries(node: Node, count: int, what: str) -> list[Node]:
    if not isinstance(node.value, list) or len(node.value) != count:
        raise node.refused(f"expected a list of {count} {what}, found {describe_found(node)}")
    return node.value


LEAVES: dict[Any, Callable[[Node, Rule], Any]] = {
    bool: read_bool,
    int: read_whole,
    float: read_number,
    str: read_text,
    Path: read_path,
    Triple: read_vector,
    Count: read_counts,
    Size: read_counts,
    Pair: read_vector,
    Paths: read_paths,
    Matrix: read_matrix,
    Color: read_color,
    Backdrop: read_backdrop,
    Iterations: read_iterations,
    tuple[float, ...]: read_fraction_list,
}
