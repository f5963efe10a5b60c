"""What a type checker knows of the front door: right lines pass its strictest mode, wrong ones do
not."""

import re
from pathlib import Path

import pytest
from mypy import api

import ddrecon

ROOT = Path(__file__).parents[1]
RIGHT = """
import torch
import ddrecon
from ddrecon.variables.values import value_of, variable_names, with_values
scene = ddrecon.load_scene("a.yaml", overrides=["volume.g=0.3"], dtype=torch.float64)
layer = ddrecon.VolumeRenderer(scene).to(torch.float32)
def image(density: torch.Tensor) -> torch.Tensor:
    return layer(density=density, view="front", values={"g": value_of(scene, "g")})
def mean(density: torch.Tensor) -> torch.Tensor:
    return ddrecon.render(with_values(scene, {"density": density})).mean()
def last(found: ddrecon.Result) -> float:
    return found.rows[-1].loss + last(ddrecon.optimize(scene, 3)) + len(variable_names(scene))
def frames() -> list[ddrecon.Scene]:
    return [frame.scene for frame in ddrecon.optimize_sequence("film.yaml")]
try:
    ddrecon.use_engine("torch")
except (ddrecon.UsageError, ddrecon.SolveError) as error:
    print(error.exit_code)
"""
WRONG = """
ddrecon.rendre(scene)
ddrecon.render("a.yaml")
layer(density=2.0)
layer(densities=torch.ones(3))
values.with_value(scene, {})
ddrecon.load_scene("a.yaml", overrides="a=b").volumes
ddrecon.optimize(scene, "many")
"""


@pytest.mark.slow
def test_a_type_checker_knows_right_from_wrong(tmp_path, monkeypatch):
    monkeypatch.setenv("MYPYPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "user.py").write_text(f"{RIGHT}from ddrecon.variables import values{WRONG}")
    told, problem, _ = api.run(["--strict", "--cache-dir", f"{ROOT}/.mypy_cache/user", "user.py"])
    wrong = range(RIGHT.count("\n") + 2, RIGHT.count("\n") + WRONG.count("\n") + 1)
    assert {int(line) for line in re.findall(r"^user\.py:(\d+): error", told, re.M)} == {*wrong}, (
        told
    )
    assert not problem


def test_what_it_knows_is_there():
    """The names that are imported for it alone, and those that are imported when first used."""
    text = Path(ddrecon.__file__).read_text(encoding="utf-8")
    names = re.findall(r"^    from \S+ import (\w+) as \1$", text, re.M)
    assert {*names} == {*ddrecon._HOMES} and all(hasattr(ddrecon, name) for name in names)
