"""The table of variables: every kind can be set and optimized as its row says."""

from pathlib import Path

import pytest
import torch
from media import make_scene

from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import ParameterSettings
from ddrecon.variables.kinds import KINDS, kind_of, pattern_of
from ddrecon.variables.values import component_names, value_of, variable_names, with_values

CONFIG = Path(__file__).parents[2] / "configs" / "gradcheck_all.yaml"
SMALL = ["volume.resolution=[5, 4, 3]", "volume.density=0.7", "volume.sigma_a=[0.3, 0.4, 0.5]"]
SMALL += ["lights.0.irradiance=[3, 2, 1]", "lights.2.directions=3", "diffusion.transport_rounds=0"]
SMALL += [f"views.{index}.camera.resolution=[7, 6]" for index in range(4)]
LOBES = "volume.phase={type: two_lobe, g: [0.6, -0.3], weight: [0.7, 0.6, 0.5]}"
MEDIA = (
    "volume={bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}, resolution: [5, 4, 3], media:"
    " {smoke: {density: 0.7, sigma_a: 1, sigma_s: 3, g: 0.5},"
    " air: {density: 1, sigma_a: 0, sigma_s: 1, phase: {type: rayleigh}}}}"
)
SECTIONS = "sigma_a", "sigma_s", "sigma_t", "albedo"
PHASES = {"phase.g": LOBES, "phase.weight": LOBES, "media.NAME.g": MEDIA}
"""Volumes that have numbers of phase functions other than g."""


@pytest.fixture(scope="module")
def scenes():
    """Scenes with every kind of light, in which all kinds of variables occur, by phase function."""
    phases = {"": ["volume.g=0.3"]}
    others = ["volume.g=0", "optimize="]
    phases |= {volume: [*others, volume] for volume in PHASES.values()}
    return {
        phase: load_scene(CONFIG, overrides=[*SMALL, *changes], dtype=torch.float64)
        for phase, changes in phases.items()
    }


@pytest.fixture
def scene(scenes, request):
    """The one that has a variable of the kind in question."""
    return scenes[PHASES.get(request.node.callspec.params["pattern"], "")]


def name_of(pattern, scene):
    """The last variable of `scene` that follows `pattern`: of lights, the one with colors."""
    return [name for name in variable_names(scene) if pattern_of(name) == pattern][-1]


def test_the_table_has_every_variable_of_a_scene_and_no_other(scenes):
    names = [name for scene in scenes.values() for name in variable_names(scene)]
    assert {pattern_of(name) for name in names} == set(KINDS)


@pytest.mark.parametrize("pattern", KINDS)
def test_a_kind_is_settable_alone(scene, pattern):
    """The scene keeps its own value, and what is put in comes out again; all else stays.

    What pictures have of its derivative is in `tests/validate/test_gradcheck.py`.
    """
    name = name_of(pattern, scene)
    before = value_of(scene, name).clone()
    value = 0.9 * before + 0.01
    changed = with_values(scene, {name: value})
    # a camera that was moved is as far from itself as before: not at all
    expected = torch.zeros_like(value) if pattern == "views.NAME.camera" else value
    torch.testing.assert_close(value_of(changed, name), expected, rtol=1e-14, atol=0)
    owner, _, key = name.rpartition(".")
    follows = {f"{owner}.{section}".strip(".") for section in SECTIONS if key in SECTIONS}
    for other in {*variable_names(scene)} - follows - {name}:
        assert torch.equal(value_of(changed, other), value_of(scene, other)), other
    assert torch.equal(value_of(scene, name), before)


@pytest.mark.parametrize("pattern", KINDS)
def test_values_are_within_bounds_and_stay_there_as_they_move(scene, pattern):
    kind, name = KINDS[pattern], name_of(pattern, scene)
    value = value_of(scene, name)
    assert kind.low < kind.high and bool((value >= kind.low).all() and (value <= kind.high).all())
    change = kind.change(scene, name, value)
    assert bool((torch.as_tensor(change) > 0).all())
    if kind.low == 0 and not value.any():
        value = value + change
    for steps in (20, -20):
        parameter = Parameter(name, ParameterSettings(), value, scene.volume.grid)
        moved = parameter.project(value + steps * torch.as_tensor(change).expand_as(value))
        assert bool((moved >= kind.low).all() and (moved <= kind.high).all())
        assert not torch.equal(moved, value) or kind.is_direction
        if kind.is_direction:
            torch.testing.assert_close(moved.norm(), value.norm())


@pytest.mark.parametrize("pattern", KINDS)
def test_the_axes_of_a_value_are_those_of_its_kind(scene, pattern):
    kind, name = KINDS[pattern], name_of(pattern, scene)
    value, cells = value_of(scene, name), scene.volume.grid.shape
    components = component_names(name, value)
    assert len(components) == (value.shape[0] if kind.is_color or kind.components else 0)
    assert len(set(components)) == len(components)
    if kind.is_cellwise:
        field = torch.full((*([3] if kind.is_color else []), *cells), 0.5, dtype=torch.float64)
        changed = with_values(scene, {name: field})
        torch.testing.assert_close(value_of(changed, name), field, rtol=1e-14, atol=0)


@pytest.mark.parametrize("name", ["emission", "views.front.offset"])
def test_what_masked_pixels_hold_leaves_changes_alone(name):
    changes = []
    for lamp in (0.0, 1000.0):
        scene = make_scene(torch.ones(2, 2, 2), emission=torch.zeros(1))
        image, mask = torch.full((3, 4, 5), 0.2), torch.ones(4, 5)
        image[:, 1, 2], mask[1, 2] = lamp, 0
        scene.views = [View("front", scene.views[0].camera, image, mask)]
        changes.append(float(kind_of(name).change(scene, name, torch.zeros(1))))
    assert changes[0] == changes[1] > 0
