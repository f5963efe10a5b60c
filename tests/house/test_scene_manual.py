"""The manual of scene files says what the schema says, of every key."""

import importlib.util
from dataclasses import is_dataclass
from pathlib import Path
from types import ModuleType

import pytest

from ddrecon import settings
from ddrecon.scene_file import schema, view_schema
from ddrecon.variables.kinds import KINDS

DOCS = Path(__file__).parents[2] / "docs"
WITHOUT_SECTION = {
    schema.Bounds,
    schema.BoxSection,
    schema.SceneTree,
    view_schema.PoseSection,
}
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


def test_every_record_has_its_section_and_every_key_its_sentence(manual: ModuleType) -> None:
    modules = schema, view_schema, settings
    names = [value for module in modules for value in vars(module).values()]
    records = {value for value in names if isinstance(value, type) and is_dataclass(value)}
    assert {record for _, record in manual.SECTIONS} == records - WITHOUT_SECTION
    for record in records:
        introduction, sentences = manual.explain(record)
        assert introduction and all(text.endswith(".") for text in sentences.values())


def test_numbers_in_sentences_are_those_of_the_program(manual: ModuleType) -> None:
    _, sentences = manual.explain(settings.ParameterSettings)
    assert f"{KINDS['density'].tv:g} for density and emission" in sentences["tv"]


def test_keys_for_experts_stand_on_their_page_alone(manual: ModuleType) -> None:
    ordinary, expert = (manual.pages()[name] for name in ("scene_file.md", "expert_keys.md"))
    assert "| `closure` |" in expert and "| `closure` |" not in ordinary
    assert "| `tolerance` | a number, above 0, at most 0.5 |" in ordinary
