"""Keys of a scene file that are missing, or given beside what they exclude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field
from typing import Any

from ddrecon.scene_file.nodes import Node


def find_absences(
    kind: type, declared: Mapping[str, Field[Any]], entries: Mapping[str, Node]
) -> list[str]:
    """What is wrong with the set of keys given of the record `kind` with the `declared` fields.

    Required keys must be there, and exactly one group of alternatives.
    """
    required = [
        name
        for name, field in declared.items()
        if field.default is MISSING and field.default_factory is MISSING
    ]
    groups: tuple[tuple[str, ...], ...] = getattr(kind, "ALTERNATIVES", ())
    filled = {name for name, child in entries.items() if child.value is not None}
    given = [group for group in groups if any(name in filled for name in group)]
    wrong = [f"missing key {name!r}" for name in required if name not in entries]
    if len(given) == 1:
        wrong += [
            f"missing key {name!r}"
            for name in given[0]
            if declared[name].default is None and name not in filled
        ]
    if groups and len(given) != 1:
        names = " or ".join(
            " and ".join(name for name in group if declared[name].default is None)
            for group in groups
        )
        wrong.append(f"{'give only one of' if given else 'missing'} {names}")
    return wrong
