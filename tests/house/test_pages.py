"""Pages: links lead somewhere, commands and scenes are legal, figures and equations are there."""

import importlib.util
import re
import shlex
from dataclasses import is_dataclass
from pathlib import Path

import click
import pytest

from ddrecon import settings
from ddrecon.cli.commands import main
from ddrecon.scene_file import schema, view_schema
from ddrecon.scene_file.load import read_scene

ROOT = Path(__file__).parents[2]
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [path for kind in ("*.md", "docs/**/*.md", "data/**/*.md") for path in ROOT.glob(kind)]
LINK = re.compile(r"\]\(([^()\s]+)\)")
FILE = re.compile(r"`(?:python )?((?:ddrecon|tests|benchmarks|docs|configs|data|\.ci)/[\w./-]*)")
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def load_module(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def anchors_of(page):
    """What a link to a heading of `page` may hold after the #, on GitHub and the built site."""
    headings = re.findall(r"^#+ (.*)", FENCED.sub("", page.read_text()), re.MULTILINE)
    words = [re.sub(r"[^\w\s-]", "", heading).lower() for heading in headings]
    return {word.replace(" ", "-") for word in words} & {
        re.sub(r"[-\s]+", "-", word.strip()) for word in words
    }


@pytest.mark.parametrize("page", sorted(PAGES), ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_links_to_and_names_is_there(page):
    text = page.read_text(encoding="utf-8")
    assert [file for file in FILE.findall(text) if not (ROOT / file).exists()] == []
    for target in LINK.findall(FENCED.sub("", text)):
        path, _, anchor = target.partition("#")
        if "://" not in target and not target.startswith("mailto:"):
            there = (page.parent / path).resolve() if path else page
            assert there.exists(), f"{target}: there is no {there}"
            assert not anchor or anchor in anchors_of(there), f"{target}: no such heading"


def test_every_page_is_in_the_menu():
    listed = re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(page.name for page in DOCS)


# --- commands and scenes ---


def scenes():
    """Every block of YAML on a page that is a whole scene."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *DOCS])
    return re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands():
    """Every `ddrecon ...` in comments of configs."""
    configs = sorted((ROOT / "configs").rglob("*.yaml"))
    text = "\n".join(config.read_text(encoding="utf-8") for config in configs)
    return [*dict.fromkeys(re.findall(r"^#.*?(ddrecon .*)$", text, re.MULTILINE))]


@pytest.mark.parametrize("line", commands())
def test_a_command_is_understood(line):
    """It is parsed, not run."""
    name, *arguments = shlex.split(line, comments=True)[1:]
    command = main.get_command(click.Context(main), name)
    assert command is not None
    assert (ROOT / command.make_context(name, arguments).params["source"]).is_file()


@pytest.mark.parametrize("text", scenes())
def test_a_scene_on_a_page_is_legal(tmp_path, text):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    assert read_scene(path).tree.views


# --- the manual of scene files ---

WITHOUT_SECTION = {schema.Bounds, schema.BoxSection, schema.SceneTree, view_schema.PoseSection}
"""Records whose keys are explained with those of others."""


def test_the_manual_says_what_the_schema_says_of_every_key():
    manual = load_module(ROOT / "docs" / "make_scene_file.py")
    for name, text in manual.pages().items():
        assert (ROOT / "docs" / name).read_text() == text, "run: python docs/make_scene_file.py"
    modules = schema, view_schema, settings
    names = [value for module in modules for value in vars(module).values()]
    records = {value for value in names if isinstance(value, type) and is_dataclass(value)}
    assert {record for _, record in manual.SECTIONS} == records - WITHOUT_SECTION
    for record in records:
        introduction, sentences = manual.explain(record)
        assert introduction and all(text.endswith(".") for text in sentences.values())


# --- figures ---

MEASURED = re.compile(r"\d ?(?:dB|ms|s|seconds|minutes|MiB)\b(?! pass)|\d times (?:as|less|more)\b")
"""A number with the unit of a measurement."""
FIGURES = load_module(ROOT / "benchmarks" / "figures.py")


def test_each_figure_stands_once_with_what_made_it():
    """A long one stands in benchmarks/tables.md, and a page names it."""
    texts = {page.name: page.read_text(encoding="utf-8") for page in FIGURES.pages()}
    places = [place for text in texts.values() for place in FIGURES.PLACE.finditer(text)]
    assert sorted(place[2] for place in places) == sorted(["summary", *FIGURES.COMMANDS])
    for name, text in FIGURES.read_figures().items():
        made = r"^\*`(python benchmarks/|ddrecon )[^`]+`, commit `\w+`, \d{4}-\d\d-\d\d, .+\*$"
        assert name == "summary" or re.search(made, text, re.MULTILINE), name
    long = FIGURES.PLACE.findall(texts.pop("tables.md"))
    assert [name for _, name, *_ in long if f"`{name}`" not in "".join(texts.values())] == []


def test_the_readme_shows_what_other_figures_say():
    figures = FIGURES.read_figures()
    assert figures["summary"] == FIGURES.show_summary(figures), "benchmarks/figures.py summary"


@pytest.mark.parametrize("name", ["README", "accuracy", "benchmarks", "capture", "gallery"])
def test_pages_quote_no_other_figure(name):
    page = ROOT / ("" if name == "README" else "docs") / f"{name}.md"
    text = FIGURES.PLACE.sub("", page.read_text(encoding="utf-8"))
    assert [line for line in text.splitlines() if MEASURED.search(line)] == []


def test_every_experiment_of_the_paper_has_a_config_and_a_picture():
    names = {config.stem for config in (ROOT / "configs" / "paper").glob("*.yaml")}
    page = (ROOT / "docs" / "experiments.md").read_text()
    pictures = re.findall(r"\]\((pictures/paper/.*?)\)", page)
    assert names <= {Path(picture).stem for picture in pictures}
    assert {int(name[3:5]) for name in names} == {6, 7, 8, 9, 10, 12, 13, 14}
    assert max((ROOT / "docs" / picture).stat().st_size for picture in pictures) < 150_000


# --- equations ---

TAG = re.compile(r"\bE(\d+)\.(\d+)(?:-E?\1\.(\d+))?\b")


def tags(text):
    """Section and number of tags in `text`; E2.4-E2.6 stands for E2.4, E2.5 and E2.6."""
    return {
        (int(section), number)
        for section, first, last in TAG.findall(text)
        for number in range(int(first), int(last or first) + 1)
    }


def test_equations_are_stated_once_in_order_and_those_are_cited_where_they_are_computed():
    pages = [(ROOT / "docs" / name).read_text() for name in ("theory.md", "corrections.md")]
    stated = [
        [
            tag
            for line in re.findall(r"^\*\*(E[\d.]+)\*\*", page, re.MULTILINE)
            for tag in tags(line)
        ]
        for page in pages
    ]
    assert all(tags_of_page == sorted(set(tags_of_page)) for tags_of_page in stated)
    every = sorted(stated[0] + stated[1])
    assert len(every) == len(set(every))
    sources = [path for kind in ("*.py", "*.h") for path in (ROOT / "ddrecon").rglob(kind)]
    cited = {str(path): tags(path.read_text()) for path in sources}
    assert {path: of - set(every) for path, of in cited.items() if of - set(every)} == {}
    assert set().union(*cited.values()) == set(every)
