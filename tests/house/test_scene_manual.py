"""The manual of scene files says what the schema says, of every key."""

from __future__ import annotations

import importlib.util
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType

import pytest

from ddrecon import settings
from ddrecon.scene_file import camera_schema, light_schema, phase_schema, schema

DOCS = Path(__file__).parents[2] / "docs"
ELSEWHERE = {schema.Constant, schema.Bounds, camera_schema.PoseSection, schema.SceneTree}
"""Records whose keys are explained with those of others."""


@pytest.fixture(scope="module")
def manual() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_scene_file", DOCS / "make_scene_file.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_what_the_schema_makes_of_it(manual: ModuleType) -> None:
    assert (DOCS / "scene_file.md").read_text() == manual.page(), (
        "run: python docs/make_scene_file.py"
    )


def test_every_key_of_every_record_is_explained(manual: ModuleType) -> None:
    modules = camera_schema, schema, light_schema, phase_schema, settings
    names = [value for module in modules for value in vars(module).values()]
    records = {value for value in names if isinstance(value, type) and is_dataclass(value)}
    explained = {record: set(texts) for _, record, _, texts in manual.SECTIONS}
    assert set(explained) == records - ELSEWHERE
    pose = {field.name for field in fields(camera_schema.PoseSection)}
    for record, keys in explained.items():
        known = {field.name for field in fields(record)}
        assert keys == known - (pose if record is camera_schema.OrthographicSection else set())


def test_no_key_takes_just_a_mapping_unless_it_is_one(manual: ModuleType) -> None:
    plain = {"bounds", "camera", "distortion", "ring", "parameters", "noise"}
    rows = [line.split("|") for line in manual.page().splitlines() if line.startswith("| `")]
    assert {row[1].strip(" `") for row in rows if row[2].strip().startswith("mapping")} == plain
