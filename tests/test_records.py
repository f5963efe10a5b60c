"""A record made in Python is judged by the types and limits that its fields declare."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import pytest

from ddrecon.diffusion.closures import CLOSURES
from ddrecon.losses import LOSSES
from ddrecon.records import bounded, faults_of, one_of
from ddrecon.scene_file.view_schema import FisheyeSection, OpencvSection
from ddrecon.settings import LENSES, DiffusionSettings, OptimizeSettings
from ddrecon.transport.sweep import DIRECTIONS


@dataclass(frozen=True)
class Leaf:
    name: str
    share: float = bounded(0.5, above=0, maximum=1)


@dataclass(frozen=True)
class Tree:
    count: int = bounded(2, minimum=1)
    size: tuple[int, int] = bounded((3, 4), minimum=1)
    steps: tuple[float, ...] = bounded((0.1,), below=1)
    kind: str | None = one_of(None, ("a", "b"))
    is_on: bool = True
    end: int | Literal["auto"] = "auto"
    leaves: list[Leaf] = field(default_factory=list)
    named: Mapping[str, Leaf] = field(default_factory=dict)


@pytest.mark.parametrize(
    "changes",
    [{}, {"count": 7}, {"size": [1, 2]}, {"steps": ()}, {"kind": "b"}, {"leaves": [Leaf("x", 1)]}],
    ids=str,
)
def test_what_is_declared_is_legal(changes):
    assert not [*faults_of(replace(Tree(), **changes))]


WRONG: list[tuple[dict[str, Any], str, str]] = [
    ({"count": 0}, "count", "must be at least 1, found 0"),
    ({"count": 1.5}, "count", "expected a whole number, found 1.5"),
    ({"count": True}, "count", "expected a whole number, found True"),
    ({"size": (1, 2, 3)}, "size", "expected 2 numbers, found (1, 2, 3)"),
    ({"size": "ab"}, "size", "expected 2 numbers, found 'ab'"),
    ({"end": "never"}, "end", "expected a whole number or 'auto', found 'never'"),
    ({"size": (0, 2)}, "size.0", "must be at least 1, found 0"),
    ({"steps": (0.1, math.nan)}, "steps.1", "must be finite, found nan"),
    ({"kind": "c"}, "kind", "expected one of a, b, found 'c'"),
    ({"is_on": None}, "is_on", "expected true or false, found None"),
    ({"leaves": [None]}, "leaves.0", "expected Leaf, found None"),
    ({"leaves": [Leaf("x", 0.0)]}, "leaves.x.share", "must be above 0, found 0"),
    ({"named": {"y": Leaf("x", "z")}}, "named.y.share", "expected a number, found 'z'"),  # type: ignore[arg-type]
    ({"leaves": {}}, "leaves", "expected list, found dict"),
]


@pytest.mark.parametrize(("changes", "key", "what"), WRONG, ids=str)
def test_what_is_not_is_told_with_its_key(changes, key, what):
    assert [*faults_of(replace(Tree(), **changes), "tree")] == [(f"tree.{key}", what)]


@pytest.mark.parametrize(
    ("record", "key", "table"),
    [
        (DiffusionSettings, "closure", CLOSURES),
        (DiffusionSettings, "degree", DIRECTIONS),
        (OptimizeSettings, "loss", LOSSES),
    ],
)
def test_a_scene_may_ask_for_whatever_is_in_a_table(record, key, table):
    choices = {field.name: field.metadata.get("choices") for field in fields(record)}
    assert list(choices[key]) == list(table)


@pytest.mark.parametrize("section", [OpencvSection, FisheyeSection])
def test_a_lens_has_its_coefficients_in_order(section):
    assert LENSES[section.type] == tuple(field.name for field in fields(section))
