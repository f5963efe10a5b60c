"""Scenes written back, with every default filled in and every path absolute.

Reading the result gives the same tree.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

from ddrecon.io.files.atomic import replace_file
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.nodes import resolve


def describe(scene_file: SceneFile) -> dict[str, Any]:
    """The resolved scene in plain mappings, lists, numbers and text."""
    return dict(_plain(scene_file.tree))


def dump_scene(scene_file: SceneFile, path: Path) -> None:
    """Writes the resolved scene to `path` as YAML that `read_scene` reads back as the same tree."""
    write_described(describe(scene_file), path)


def write_described(described: dict[str, Any], path: Path) -> None:
    """Writes a scene in plain values, as `describe` returns it, to `path`."""
    text = yaml.dump(
        described,
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        width=10**6,
        default_flow_style=None,
    )
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        tag = {"type": value.type} if hasattr(value, "type") else {}
        given = {field.name: getattr(value, field.name) for field in fields(value)}
        # Nor what belongs to an alternative that was not taken.
        groups = getattr(value, "ALTERNATIVES", ())
        left_out = {name for group in groups if given[group[0]] is None for name in group}
        left_out |= {"g"} if given.get("phase") is not None else set()
        return tag | {
            name: _plain(entry)
            for name, entry in given.items()
            if entry is not None and name not in left_out
        }
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


class _Dumper(yaml.SafeDumper):
    """Quotes text that would be read as something else; PyYAML itself goes by YAML 1.1."""


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar(
        "tag:yaml.org,2002:str", text, style=None if resolve(text) == text else '"'
    ),
)
