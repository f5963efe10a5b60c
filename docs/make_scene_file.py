"""Makes scene_file.md and expert_keys.md, the manual of scene files, and scene.schema.json.

Keys, kinds, limits and defaults are those the program checks. Run it after each change of them:

    python docs/make_scene_file.py
"""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from ddrecon import settings
from ddrecon.records import LIMITS, alternatives, is_required, type_hints
from ddrecon.scene_file import schema, view_schema
from ddrecon.scene_file.read import describe_type
from ddrecon.variables.kinds import KINDS

FOLDER = Path(__file__).parent
EXPERT = """\
# Keys for experts

No scene needs them: they choose between ways to compute the same, for comparisons and experiments.
They stand in the sections of [the scene file](scene_file.md) that are named here.
`ddrecon check` tells which of them are not at their default."""
INTRODUCTION = """\
Every key, with what it takes, its limits and its default, made from the program's own schema.

- Vectors are x, y, z.
- Lengths are in a world unit u of your choice.
- `1e-3` is a number.
- Paths are relative to the scene file; those of `-D` and `--light` to the current folder.
- Three equal colors are rendered as one, unless they are optimized.

Anything unknown, repeated or out of its limits is refused with file, line, column and key.
[Keys for experts](expert_keys.md) have a page of their own.
Small scenes with other phase functions, models and losses are in `configs/kinds`.

Editors that know YAML complete and check keys by [scene.schema.json](scene.schema.json).
Its place is the file's first line: `# yaml-language-server: $schema=PATH/scene.schema.json`."""
PARAMETERS = """\
## Names of parameters

What can be found.
N is the place of a light in its list, counted from 0.
NAME is a view's name, or `*` for all training views.
Where there are two media, `media.cloud.density` is as `density` is, and so on.
Colors have entries `.r`, `.g`, `.b`; places and directions have `.x`, `.y`, `.z`.
A lens has its coefficients, `.k1` and so on.
A `camera` has `.rotation_x` ... and `.x` ...: a rotation about the middle of the box [radians], \
then a shift [u], both in its axes (right, up, backward).
A `focal` length is in widths of the image.
`render --gradient` and `gradcheck --parameter` take the same names.

| name | kept within | by color | from cell to cell |
|---|---|---|---|"""
SECTIONS: list[tuple[str, type]] = [
    ("volume", schema.VolumeSection),
    ("volume: {media: ...}", schema.MixtureSection),
    ("volume.media.NAME", schema.MediumSection),
    ("volume.density, sigma_a, ...: {file: ...}", settings.FieldFile),
    ("volume.density, sigma_a, ...: {heights: ...}", schema.ByHeight),
    ("volume.density, sigma_a, ...: {labels: ...}", schema.ByLabel),
    ("volume.sigma_t: {meters: ...}", schema.Water),
    ("volume.phase: {type: henyey_greenstein}", schema.HenyeyGreensteinSection),
    ("volume.phase: {type: two_lobe}", schema.TwoLobeSection),
    ("volume.phase: {type: rayleigh}", schema.RayleighSection),
    ("volume.phase: {type: table}", schema.TableSection),
    ("volume.phase: {type: mie}", schema.MieSection),
    ("ground", schema.GroundSection),
    ("lights: {type: directional}", schema.DirectionalSection),
    ("lights: {type: ambient}", schema.AmbientSection),
    ("lights: {type: environment}", schema.EnvironmentSection),
    ("lights: {type: point}", schema.PointSection),
    ("lights: {type: beam}", schema.BeamSection),
    ("views", view_schema.ViewSection),
    ("views: {ring: ...}, {transforms: ...} or {colmap: ...}", view_schema.ViewSource),
    ("views: {ring: ...}", view_schema.RingSection),
    ("camera: {type: perspective}", view_schema.PerspectiveSection),
    ("distortion: {type: opencv}", view_schema.OpencvSection),
    ("distortion: {type: fisheye}", view_schema.FisheyeSection),
    ("camera: {type: orthographic}", view_schema.OrthographicSection),
    ("frames", view_schema.FramesSection),
    ("render", settings.RenderSettings),
    ("diffusion", settings.DiffusionSettings),
    ("optimize", settings.OptimizeSettings),
    ("optimize.noise", settings.NoiseSettings),
    ("optimize.parameters: {NAME: ...}", settings.ParameterSettings),
]
"""Each section: its heading, and its record."""


def main() -> None:
    """Writes the pages."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each page, by the name of its file."""
    manual = ["# The scene file", INTRODUCTION, *_sections(is_expert=False), _parameters()]
    return {
        "scene_file.md": "\n\n".join(manual) + "\n",
        "expert_keys.md": "\n\n".join([EXPERT, *_sections(is_expert=True)]) + "\n",
        "scene.schema.json": json_schema(),
    }


def explain(record: type) -> tuple[str, dict[str, str]]:
    """What the docstring of `record` says: of the section, a sentence a line, and of each key.

    Keys of the records that it inherits from are theirs, unless it explains them itself.
    """
    introduction, sentences = "", dict[str, str]()
    for base in reversed(record.__mro__[:-1]):
        introduction, *entries = re.split(
            r"\n(?=[a-z_0-9]+(?:, [a-z_0-9]+)*: )", inspect.cleandoc(base.__doc__ or "")
        )
        for names, sentence in (entry.split(": ", 1) for entry in entries):
            sentences |= dict.fromkeys(names.split(", "), " ".join(sentence.split()))
    ordered = {key.name: sentences[key.name] for key in fields(record)}
    return re.sub(r"(?<=\.) (?=[A-Z`\[])", "\n", " ".join(introduction.split())), ordered


def _sections(is_expert: bool) -> list[str]:
    """Each section, with a table of its keys that are for experts, or of the others."""
    sections = []
    for heading, record in SECTIONS:
        introduction, sentences = explain(record)
        hints = type_hints(record)
        rows = _joined(
            (key.name, f"{_takes(hints[key.name], key)} | {_default(key)} | {sentences[key.name]}")
            for key in fields(record)
            if bool(key.metadata.get("expert")) == is_expert
        )
        table = ["", "| key | takes | default | what |", "|---|---|---|---|", *rows] if rows else []
        if rows or not is_expert:
            lead = [] if is_expert else ["", introduction]
            sections.append("\n".join([f"## {heading}", *lead, *table]))
    return sections


def _joined(entries: Iterable[tuple[str, str]]) -> list[str]:
    """A row for each text; names that have the same stand together."""
    names: dict[str, list[str]] = {}
    for name, text in entries:
        names.setdefault(text, []).append(f"`{name}`")
    return [f"| {', '.join(group)} | {text} |" for text, group in names.items()]


def _takes(hint: Any, field: Field[Any]) -> str:
    """What a key takes, in words, with its limits."""
    limits = field.metadata
    if "choices" in limits:
        return ", ".join(f"`{choice}`" for choice in limits["choices"])
    within = [f"{LIMITS[key][0]} {limits[key]:g}" for key in limits if key in LIMITS]
    return ", ".join([describe_type(hint), *within])


def _default(field: Field[Any]) -> str:
    """What stands where the key is left out."""
    if is_required(field):
        return "required"
    value = field.default
    if value is None or value is MISSING:
        return ""
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{entry:g}' for entry in value)}]`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _parameters() -> str:
    """The table of what can be optimized."""
    entries = []
    for name, kind in KINDS.items():
        by_color, by_cell = ("yes" if holds else "" for holds in (kind.is_color, kind.is_cellwise))
        within = f"at least {kind.low:g}" if kind.low > -math.inf else ""
        within = f"{kind.low:g} to {kind.high:g}" if kind.high < math.inf else within
        entries.append((name, f"{within} | {by_color} | {by_cell}"))
    return "\n".join([PARAMETERS, *_joined(entries)])


NUMBERS = {
    "minimum": "minimum",
    "above": "exclusiveMinimum",
    "maximum": "maximum",
    "below": "exclusiveMaximum",
}
PLAIN = {NoneType: "null", bool: "boolean", int: "integer", float: "number", str: "string"}


def json_schema() -> str:
    """The scene file as a JSON schema, which editors know; a line for each record."""
    defined: dict[str, Any] = {}
    _one(schema.SceneTree, {}, defined)
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in defined.items()]
    head = '"$schema": "https://json-schema.org/draft/2020-12/schema", "$ref": "#/$defs/SceneTree"'
    return f'{{{head}, "$defs": {{\n' + ",\n".join(lines) + "\n}}\n"


def _define(record: type, defined: dict[str, Any]) -> dict[str, Any]:
    """A reference to `record`, which is put into `defined` with all that it refers to."""
    reference = {"$ref": f"#/$defs/{record.__name__}"}
    if record.__name__ in defined:
        return reference
    sentences = explain(record)[1]
    tag = {"type": {"const": record.type}} if hasattr(record, "type") else {}
    entry: dict[str, Any] = {"type": "object", "additionalProperties": False, "properties": tag}
    defined[record.__name__] = entry
    entry["required"] = [*tag, *(field.name for field in fields(record) if is_required(field))]
    for field in fields(record):
        hints = [*alternatives(type_hints(record)[field.name]), *field.metadata.get("also", ())]
        about = {"description": sentences[field.name]}
        tag[field.name] = about | _any_of(hints, field.metadata, defined)
    return reference


def _any_of(hints: Any, limits: Mapping[str, Any], defined: dict[str, Any]) -> dict[str, Any]:
    schemas = [_one(hint, limits, defined) for hint in hints]
    if settings.FieldFile in hints and float in hints:
        number = _one(float, limits, defined)
        schemas.append(
            {"type": "object", "properties": {"constant": number}, "required": ["constant"]}
        )
    return schemas[0] if len(schemas) == 1 else {"anyOf": schemas}


def _one(hint: Any, limits: Mapping[str, Any], defined: dict[str, Any]) -> dict[str, Any]:
    arguments, origin = get_args(hint), get_origin(hint)
    if is_dataclass(hint):
        return _define(hint, defined)  # type: ignore[arg-type]
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin is tuple:
        count = len(arguments)
        size = {} if arguments[-1] is Ellipsis else {"minItems": count, "maxItems": count}
        items = _any_of(alternatives(arguments[0]), limits, defined)
        return {"type": "array", "items": items} | size
    if origin is Mapping:
        return {"type": "object", "additionalProperties": _any_of([arguments[1]], {}, defined)}
    if hint in (int, str) and "choices" in limits:
        return {"enum": list(limits["choices"])}
    within = {NUMBERS[key]: value for key, value in limits.items() if key in NUMBERS}
    return {"type": PLAIN.get(hint, "string")} | (within if hint in (int, float) else {})


if __name__ == "__main__":
    main()
