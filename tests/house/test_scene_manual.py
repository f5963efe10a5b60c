"""The manual of scene files says what the schema says, of every key."""

import importlib.util
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType

import pytest

from ddrecon import settings
from ddrecon.scene_file import schema

DOCS = Path(__file__).parents[2] / "docs"
ELSEWHERE = {schema.Bounds, schema.PoseSection, schema.SceneTree}
"""Records whose keys are explained with those of others."""


@pytest.fixture(scope="module")
def manual() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_scene_file", DOCS / "make_scene_file.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_are_what_the_schema_makes_of_them(manual: ModuleType) -> None:
    for name, text in manual.pages().items():
        assert (DOCS / name).read_text() == text, "run: python docs/make_scene_file.py"


def test_every_key_of_every_record_is_explained(manual: ModuleType) -> None:
    modules = schema, settings
    names = [value for module in modules for value in vars(module).values()]
    records = {value for value in names if isinstance(value, type) and is_dataclass(value)}
    explained = {record: set(texts) for _, record, _, texts in manual.SECTIONS}
    assert set(explained) == records - ELSEWHERE
    pose = {field.name for field in fields(schema.PoseSection)}
    for record, keys in explained.items():
        known = {field.name for field in fields(record)}
        assert keys == known - (pose if record is schema.OrthographicSection else set())


def test_keys_for_experts_stand_on_their_page_alone(manual: ModuleType) -> None:
    ordinary, expert = (manual.pages()[name] for name in ("scene_file.md", "expert_keys.md"))
    assert "| `closure` |" in expert and "| `closure` |" not in ordinary
    assert "| `tolerance` | a number, above 0, at most 0.5 |" in ordinary
