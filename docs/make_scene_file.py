"""Makes scene_file.md, the manual of scene files, and scene.schema.json.

Keys, kinds, limits and defaults are those the program checks. Run it after each change of them:

    python docs/make_scene_file.py
"""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from itertools import groupby
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from ddrecon import settings
from ddrecon.records import LIMITS, alternatives, is_required, type_hints
from ddrecon.scene_file import schema, view_schema
from ddrecon.scene_file.read import describe_type
from ddrecon.variables.kinds import KINDS

FOLDER = Path(__file__).parent
COLUMNS = "takes | default | what |"
EXPERT = f"""\
## Keys for experts

No scene needs them: they choose between ways to compute the same, for comparisons and experiments.
`ddrecon check` tells which of them are not at their default.

| in | key | {COLUMNS}
|---|---|---|---|---|"""
INTRODUCTION = """\
Every key, with what it takes, its limits and its default, made from the program's own schema.

- Vectors are x, y, z, and lengths in a world unit u of your choice; `1e-3` is a number.
- Paths are relative to the scene file; those of `-D` and `--light` to the current folder.
- Three equal colors are rendered as one, unless they are optimized.

Anything unknown, repeated or out of its limits is refused with file, line, column and key.
Small scenes with other phase functions, models and losses are in `configs/kinds`.
Editors that know YAML complete and check keys by [scene.schema.json](scene.schema.json), which \
the file's first line names: `# yaml-language-server: $schema=PATH/scene.schema.json`."""
PARAMETERS = """\
## Names of parameters

What can be found: N is the place of a light in its list, counted from 0, and NAME a view's name, \
or `*` for all training views.
Where there are two media, `media.cloud.density` is as `density` is, and so on.
Colors have entries `.r`, `.g`, `.b`, places and directions `.x`, `.y`, `.z`, a lens `.k1` and \
so on.
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
    ("camera: {type: orthographic}", view_schema.OrthographicSection),
    ("distortion: {type: opencv}", view_schema.OpencvSection),
    ("distortion: {type: fisheye}", view_schema.FisheyeSection),
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
    manual = ["# The scene file", INTRODUCTION, *_sections(), _parameters(), _experts()]
    return {
        "scene_file.md": "\n\n".join(manual) + "\n",
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


def _sections() -> list[str]:
    """Each section with a table of its keys; kinds of the same thing have one together."""
    sections, told = [], dict[str, str]()
    for place, group in groupby(SECTIONS, lambda section: section[0].partition(": {")[0]):
        kinds = list(group)
        if len(kinds) > 1 and all(": {" in heading for heading, _ in kinds):
            sections.append(_kinds(place, kinds))
            continue
        for heading, record in kinds:
            rows = dict(_rows(record))
            above = {name: told[text] for text, name in rows.items() if text in told}
            told |= dict.fromkeys(rows, heading)
            lead = [explain(record)[0]]
            for owner in dict.fromkeys(above.values()):
                names = ", ".join(f"`{name}`" for name, of in above.items() if of == owner)
                lead.append(f"As in `{owner}`: {names}.")
            rows = {text: name for text, name in rows.items() if name not in above}
            table = _joined((name, text) for text, name in rows.items())
            head = ["", f"| key | {COLUMNS}", "|---|---|---|---|"] if rows else []
            sections.append("\n".join([f"## {heading}", "", *lead, *head, *table]))
    return sections


def _kinds(place: str, kinds: list[tuple[str, type]]) -> str:
    """What `place` may be: what each kind is, then their keys; keys of several stand once."""
    lines, owners = [f"## {place}", ""], dict[tuple[str, str], list[str]]()
    for heading, record in kinds:
        kind = heading.removeprefix(f"{place}: ")
        name = f"`{kind.removeprefix('{type: ').removesuffix('}') if 'type: ' in kind else kind}`"
        lines.append(f"- {name}: " + explain(record)[0].replace("\n", "\n  "))
        for text, key in _rows(record):
            owners.setdefault((key, text), []).append(name)
    lines += ["", f"| of | key | {COLUMNS}", "|---|---|---|---|---|"]
    rows = dict[tuple[str, str], list[str]]()
    for (key, text), names in owners.items():
        rows.setdefault((", ".join(names), text), []).append(f"`{key}`")
    lines += [f"| {of} | {', '.join(keys)} | {text} |" for (of, text), keys in rows.items()]
    return "\n".join(lines)


def _rows(record: type, is_expert: bool = False) -> Iterator[tuple[str, str]]:
    """What a table has of each key of `record` that is for experts, or of the others; its name."""
    sentences, hints = explain(record)[1], type_hints(record)
    for key in fields(record):
        if bool(key.metadata.get("expert")) == is_expert:
            text = f"{_takes(hints[key.name], key)} | {_default(key)} | {sentences[key.name]}"
            yield text, key.name


def _experts() -> str:
    """The table of keys that no scene needs."""
    rows = [
        f"| `{heading.partition(': {')[0]}` | `{name}` | {text} |"
        for heading, record in SECTIONS
        for text, name in _rows(record, is_expert=True)
    ]
    return "\n".join([EXPERT, *rows])


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
