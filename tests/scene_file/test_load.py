"""Scene files as records: each rule of the schema, told with line, column and key."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from example_scene import CAMERA, SCENE, changed

from ddrecon.scene_file.dump import describe, dump_scene
from ddrecon.scene_file.load import SceneFile, read_scene
from ddrecon.scene_file.schema import AmbientSection, DirectionalSection, OrthographicSection
from ddrecon.settings import (
    DiffusionSettings,
    FieldFile,
    OptimizeSettings,
    ParameterSettings,
    RenderSettings,
)

Read = Callable[..., SceneFile]
Refusal = Callable[..., list[str]]

CONTRACT = """\
volume:
  bounds: {min: [-0.5, -0.75, -0.5], max: [0.5, 0.75, 0.5]}
  resolution: [64, 96, 64]    # cells in x, y, z; may be left out where a field's file gives it
  density: {file: plume.npz}               # or {constant: 0.1}; fields and constants mix freely
  # either sigma_a + sigma_s, or sigma_t + albedo; number, [r,g,b] or {file: ...}
  sigma_a: 0.6
  sigma_s: [11.4, 10.8, 9.6]
  g: 0.3
lights:
  # direction = the way the light travels
  - {type: directional, direction: [-2, -2, -1], irradiance: 3.14159}
  - {type: ambient, radiance: [0.2, 0.3, 0.5]}    # the same from everywhere
views:
  - name: front
    image: targets/front.exr
    mask: targets/front_mask.png           # black = ignore these pixels
    split: train                           # or test: never optimised on, always reported
    camera:
      {type: perspective, origin: [0, 0.3, 3.2], target: [0, 0, 0], up: [0, 1, 0], fov: 28,
       resolution: [128, 128]}
render: {samples_per_pixel: 1, steps_per_voxel: 1, background: true}
diffusion:
  model: p1                # none | p1 | flux_limited
  scheme: conservative     # or `printed`: the paper's own central differences, for comparison
  closure: smooth          # empty-space treatment, see THEORY section 5
  solver: conjugate_gradient
  tolerance: 1e-4          # relative residual
  warm_start: true
  transport_rounds: 0
optimize:
  iterations: 300
  loss: l2                 # l2 | l1 | huber | relative_l2
  refine_at: [0.3, 0.6]    # coarse-to-fine, fractions of the run
  parameters:
    density: {init: 0.0, lr: 0.05, min: 0, tv: 1e-4}
"""


def test_the_example_of_the_contract(read: Read, tmp_path: Path):
    tree = read(CONTRACT).tree
    assert tree.volume.density == FieldFile(tmp_path / "plume.npz") and tree.volume.sigma_s == (
        11.4,
        10.8,
        9.6,
    )
    assert (
        tree.volume.bounds is not None
        and tree.volume.bounds.max == (0.5, 0.75, 0.5)
        and tree.volume.resolution == (64, 96, 64)
    )
    assert tree.lights == (
        DirectionalSection((-2, -2, -1), 3.14159),
        AmbientSection((0.2, 0.3, 0.5)),
    )
    assert tree.views[0].image == tmp_path / "targets/front.exr" and tree.views[0].split == "train"
    assert tree.diffusion.tolerance == 1e-4 and tree.render == RenderSettings(steps_per_voxel=1)
    assert (
        tree.optimize
        == OptimizeSettings(
            {"density": ParameterSettings(init=0.0, lr=0.05, min=0.0, tv=1e-4)},
            loss="l2",
            refine_at=(0.3, 0.6),
        )
        and tree.optimize.parameters["density"].tv == 1e-4
    )


def test_every_error_is_told_at_once_with_its_place(refusal: Refusal):
    text = """\
volume:
  bounds: {min: [-0.5, 0.75, -0.5], max: [0.5, 0.75, 0.5]}
  resolution: [6, 9]
  densty: {constant: 0.1}
  sigma_a: true
  sigma_s: [11.4, .inf, 9.6]
  g: 1
lights:
  - {type: directonal, direction: [0, 0, 0], irradiance: 3}
  - {type: ambient, radiance: [0.2, -0.3, 0.5]}
views:
  - {name: a/b,
     camera: {type: perspective, origin: [0, 0, 3], target: [0, 0, 0], fov: 30, resolution: [4, 4]}}
diffusion: {tolerance: 0}
"""
    assert set(refusal(text, "render.steps_per_voxel=1.5", "lights.5.radiance=1")) == {
        "scene.yaml:2:42: volume.bounds.max: 0.75 along y is not above min, 0.75",
        "scene.yaml:3:15: volume.resolution: expected a list of 3 whole numbers, found a list of 2",
        "scene.yaml:2:3: volume: missing key 'density'",
        "scene.yaml:4:3: volume.densty: unknown key; did you mean 'density'?",
        "scene.yaml:5:12: volume.sigma_a: expected a number, [r, g, b] or {file: ...}, found true",
        "scene.yaml:6:19: volume.sigma_s.1: expected a finite number of single"
        " precision, found inf",
        "scene.yaml:7:6: volume.g: must be below 1, found 1",
        "scene.yaml:9:12: lights.0.type: expected one of directional, ambient, environment,"
        " point, found 'directonal'; "
        "did you mean 'directional'?",
        "scene.yaml:10:37: lights.1.radiance.1: must be at least 0, found -0.3",
        "scene.yaml:12:12: views.0.name: 'a/b' is not a file name; use letters, digits, '_', '-'"
        " and '.', the last not at its start",
        "scene.yaml:14:24: diffusion.tolerance: must be above 0, found 0",
        "-D render.steps_per_voxel=1.5: render.steps_per_voxel: expected a whole number, found 1.5",
        "-D lights.5.radiance=1: lights.5: no such entry: lights is a list of 2, counted from 0",
    }


ONE_FAULT = [
    ("volume.g=-1", "volume.g: must be above -1"),
    ("volume.g=.nan", "volume.g: expected a finite number"),
    ("volume.g=1e400", "volume.g: expected a finite number"),
    (
        "volume.g='0.3'",
        "volume.g: expected a number or {file: ...}, found '0.3'",
    ),
    (
        "volume.g=",
        "volume.g: expected a number or {file: ...}, found nothing",
    ),
    ("volume.density=-1", "volume.density: must be at least 0"),
    (
        "volume.density=[1, 2, 3]",
        "volume.density: expected a number or {file: ...}, found a list of 3",
    ),
    ("volume.density={constant: -1}", "volume.density.constant: must be at least 0"),
    ("volume.density={constant: 1, file: a.npz}", "volume.density.constant: unknown key"),
    (
        "volume.density={file: 3}",
        "volume.density.file: expected a file, found 3 (put it in quotes)",
    ),
    ('volume.density={file: "a\\0"}', "volume.density.file: expected text that can be printed"),
    (
        "volume.sigma_a=[1, 2]",
        "volume.sigma_a: expected a number, [r, g, b] or {file: ...}, found a list of 2",
    ),
    (
        "volume.sigma_a=red",
        "volume.sigma_a: expected a number, [r, g, b] or {file: ...}, found 'red'",
    ),
    ("volume.sigma_a=-0.1", "volume.sigma_a: must be at least 0"),
    ("volume.albedo=0.5", "volume: give only one of sigma_a and sigma_s or sigma_t and albedo"),
    ("volume={density: 1}", "volume: missing sigma_a and sigma_s or sigma_t and albedo"),
    ("volume={density: 1, sigma_t: 1}", "volume: missing key 'albedo'"),
    ("volume={density: 1, sigma_t: 1, albedo: 1.5}", "volume.albedo: must be at most 1"),
    ("volume.resolution=[2, 0, 2]", "volume.resolution.1: must be at least 1"),
    ("volume.resolution=[2.0, 2, 2]", "volume.resolution.0: expected a whole number, found 2.0"),
    ("volume.resolution=[4096, 4096, 4096]", "volume.resolution: 6.9e+10 cells are too many"),
    ("volume.bounds={min: [0, 0, 0]}", "volume.bounds: missing key 'max'"),
    ("volume=3", "volume: expected a mapping, found 3"),
    ("lights=[]", "lights: expected a list with at least one entry, found a list of 0"),
    (
        "lights=[{radiance: 1}]",
        "lights.0: missing key 'type', one of directional, ambient, environment, point",
    ),
    ("lights=[{type: point, position: [0, 0, 0]}]", "lights.0: missing key 'intensity'"),
    ("lights.0.direction=[0, 0, 0]", "lights.0.direction: must not be zero"),
    ("lights.0.irradiance=-1", "lights.0.irradiance: must be at least 0"),
    ("views=[]", "views: expected a list with at least one entry"),
    ("views.0.name=", "views.0.name: expected text, found nothing"),
    ("views.0.name=''", "views.0.name: expected text that can be printed, found ''"),
    ("views.0.name='..'", "views.0.name: '..' is not a file name"),
    ("views.0.name='a b'", "views.0.name: 'a b' is not a file name"),
    ("views.0.split=valid", "views.0.split: expected one of train, test, found 'valid'"),
    ("views.0.camera.fov=0", "views.0.camera.fov: must be above 0"),
    ("views.0.camera.fov=180", "views.0.camera.fov: must be below 180"),
    (
        "views.0.camera.resolution=[8, 6, 3]",
        "views.0.camera.resolution: expected a list of 2 whole numbers",
    ),
    ("views.0.camera.width=1", "views.0.camera.width: unknown key"),
    (
        "views.0.camera={type: orthographic, origin: [0, 0, 1], target: [0, 0, 0],"
        " resolution: [1, 1]}",
        "views.0.camera: missing key 'width'",
    ),
    (
        "views.0.camera={type: orthographic, width: 0, origin: [0, 0, 1], target: [0, 0, 0],"
        " resolution: [1, 1]}",
        "width: must be above 0",
    ),
    (
        "views.0.camera={type: perspective, fov: 30, resolution: [1, 1]}",
        "views.0.camera: missing matrix or origin and target",
    ),
    (
        "views.0.camera={type: perspective, fov: 30, target: [0, 0, 0], resolution: [1, 1]}",
        "views.0.camera: missing key 'origin'",
    ),
    (
        "views.0.camera={type: perspective, fov: 30, origin: [0, 0, 1], target: [0, 0, 0]}",
        "views.0.camera: missing key 'resolution'",
    ),
    (
        "views.0.camera.matrix=[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        "views.0.camera: give only one of matrix or origin and target",
    ),
    ("render.samples_per_pixel=0", "render.samples_per_pixel: must be at least 1"),
    (
        "render.samples_per_pixel=true",
        "render.samples_per_pixel: expected a whole number, found true",
    ),
    ("render.background=yes", "render.background: expected true or false, found 'yes'"),
    ("render.background=1", "render.background: expected true or false, found 1"),
    ("diffusion.model=p2", "diffusion.model: expected one of none, p1, flux_limited, found 'p2'"),
    (
        "diffusion={model: flux_limited, scheme: printed}",
        "diffusion.scheme: 'printed' is for diffusion.model p1; flux_limited needs 'conservative'",
    ),
    (
        "diffusion.transport_directions=50",
        "diffusion.transport_directions: directions follow from diffusion.degree: write degree: 3",
    ),
    (
        "diffusion.degree=4",
        "diffusion.degree: expected one of 1, 3, 5, 7, found 4",
    ),
    ("diffusion.transport_rounds=17", "diffusion.transport_rounds: must be at most 16"),
    (
        "diffusion={model: flux_limited, transport_rounds: 1}",
        "diffusion.transport_rounds: rounds begin at model p1 with scheme",
    ),
    (
        "diffusion={scheme: printed, transport_rounds: 1}",
        "diffusion.transport_rounds: rounds begin at model p1 with scheme",
    ),
    ("diffusion.tolerance=0.6", "diffusion.tolerance: must be at most 0.5"),
    ("difusion.model=p1", "difusion: unknown key; did you mean 'diffusion'?"),
    (
        "optimize={parameters: {density: {}}, optimizer: adam}",
        "optimize.optimizer: unknown key; known: parameters, iterations, loss,",
    ),
    ("optimize.iterations=10", "optimize: missing key 'parameters'"),
    ("optimize.parameters={}", "optimize.parameters: names no parameter; known: density"),
    (
        "optimize={parameters: {density: {}}, iterations: 0}",
        "optimize.iterations: must be at least 1",
    ),
    (
        "optimize={parameters: {density: {}}, loss: l3}",
        "optimize.loss: expected one of l2, l1, huber, relative_l2, display, photon, found 'l3'",
    ),
    (
        "optimize={parameters: {density: {}}, refine_at: [0.6, 0.3]}",
        "optimize.refine_at: must increase",
    ),
    (
        "optimize={parameters: {density: {}}, refine_at: [0.5, 0.5]}",
        "optimize.refine_at: must increase",
    ),
    (
        "optimize={parameters: {density: {}}, refine_at: [0, 0.5]}",
        "optimize.refine_at.0: must be above 0",
    ),
    (
        "optimize={parameters: {density: {}}, refine_at: [1.0]}",
        "optimize.refine_at.0: must be below 1",
    ),
    (
        "optimize={parameters: {densty: {}}}",
        "optimize.parameters.densty: unknown parameter; did you mean 'density'?",
    ),
    ("optimize.parameters.density.support=0.1", "density.support: expected one of masks, auto"),
    ("optimize.parameters.g.support=auto", "g.support: 'auto' is for density alone"),
    ("optimize.parameters.density.even_until=0.3", "even_until: cells are free from the start"),
    ("optimize.parameters.density.lr=0", "optimize.parameters.density.lr: must be above 0"),
    ("optimize.parameters.density.tv=-1", "optimize.parameters.density.tv: must be at least 0"),
    (
        "optimize.parameters.density={min: 2, max: 1}",
        "optimize.parameters.density.max: 1 is not above min, 2",
    ),
    (
        "optimize.parameters.density={init: 3, max: 1}",
        "optimize.parameters.density.init: 3 is not between min and max",
    ),
]


@pytest.mark.parametrize(("override", "problem"), ONE_FAULT)
def test_one_fault_is_one_line(refusal: Refusal, override: str, problem: str):
    (line,) = refusal(SCENE, override)
    assert problem in line


@pytest.mark.parametrize("section", ["volume", "lights", "views"])
def test_required_sections(refusal: Refusal, section: str):
    assert refusal(changed(**{section: None})) == [f"scene.yaml:1:1: missing key {section!r}"]


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("volume.density=2", 2.0),
        ("volume.density={constant: 2}", 2.0),
        ("optimize={parameters: {density: {init: 2}}}", 2.0),
        ("optimize={parameters: {density: {init: null}}}", None),
    ],
)
def test_spellings_of_density(read: Read, override: str, value: float | None):
    tree = read(SCENE, override).tree
    assert (
        tree.optimize.parameters["density"].init if tree.optimize else tree.volume.density
    ) == value


def test_no_refinement_is_an_empty_list(read: Read):
    optimize = read(SCENE, "optimize={parameters: {density: {}}, refine_at: []}").tree.optimize
    assert optimize is not None and optimize.refine_at == ()


RIGID = [[0.0, 0.0, 1.0, 2.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def with_matrix(matrix: list[Any]) -> str:
    return changed(
        views=[
            {"camera": {"type": "orthographic", "width": 2, "matrix": matrix, "resolution": [4, 4]}}
        ]
    )


def test_a_matrix_replaces_origin_target_and_up(read: Read):
    camera = read(with_matrix(RIGID)).tree.views[0].camera
    assert (
        isinstance(camera, OrthographicSection)
        and camera.matrix == tuple(map(tuple, RIGID))
        and camera.origin is None
    )


@pytest.mark.parametrize(
    ("row", "column", "value", "what"),
    [
        (0, 2, 1.001, "unit length"),
        (0, 0, 0.01, "perpendicular"),
        (3, 3, 2.0, "last row"),
        (1, 1, -1.0, "mirrors"),
    ],
)
def test_a_matrix_must_be_rigid(refusal: Refusal, row: int, column: int, value: float, what: str):
    matrix = [list(entries) for entries in RIGID]
    matrix[row][column] = value
    (line,) = refusal(with_matrix(matrix))
    assert "views.0.camera.matrix" in line and what in line


def test_left_out_names_count_from_zero_and_all_are_unique(read: Read, refusal: Refusal):
    views = f"views:\n  - {{name: view_01, camera: {CAMERA}}}\n  - {{camera: {CAMERA}}}\n"
    text = SCENE[: SCENE.index("views:")] + views
    assert refusal(text) == ["scene.yaml:13:5: views.1: 'view_01' is already the name of view 0"]
    assert [view.name for view in read(text, "views.0.name=view_02").tree.views] == [
        "view_02",
        "view_01",
    ]


def test_overrides_replace_add_and_reach_into_lists(read: Read):
    overrides = [
        "volume.g=0.5",
        "lights.1.radiance=[1, 2, 3]",
        "optimize.parameters.density.lr=1e-2",
        "volume.g=0.6",
        "render={}",
    ]
    tree = read(SCENE, *overrides).tree
    assert tree.volume.g == 0.6 and tree.lights[1] == AmbientSection((1, 2, 3))
    assert tree.optimize is not None and tree.optimize.parameters["density"].lr == 0.01


@pytest.mark.parametrize("name", ["lights.0.irradiance", "views.front.camera", "g"])
def test_overrides_add_parameters_whose_names_have_dots(read: Read, name: str):
    text = SCENE + "optimize: {parameters: {density: {}}}\n"
    optimize = read(text, f"optimize.parameters.{name}.lr=2").tree.optimize
    assert optimize is not None and optimize.parameters[name].lr == 2
    assert read(text, f"optimize.parameters.{name}={{}}").tree.optimize.parameters.keys() == {
        "density",
        name,
    }


def test_overrides_prefer_the_longest_key_there_is(read: Read):
    text = SCENE + "optimize:\n  parameters:\n    density: {}\n    lights.0.irradiance: {lr: 1}\n"
    optimize = read(text, "optimize.parameters.lights.0.irradiance.lr=2").tree.optimize
    assert optimize is not None and optimize.parameters["lights.0.irradiance"].lr == 2


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("volume.g", "-D volume.g: expected key.path=value"),
        ("=3", "-D =3: expected key.path=value"),
        ("volume..g=3", "-D volume..g=3: expected key.path=value"),
        ("volume.g.x=3", "-D volume.g.x=3: volume.g.x: volume.g is 0.3, not a mapping or list"),
        (
            "lights.x=3",
            "-D lights.x=3: lights.x: no such entry: lights is a list of 2, counted from 0",
        ),
        (
            "volume.g=[1",
            "-D volume.g=[1: not YAML: while parsing a flow sequence, expected ',' or ']', but"
            " got '<stream end>'",
        ),
        (
            "volume.g=*x",
            "-D volume.g=*x: volume.g: *x stands for nothing: no &x before",
        ),
        ("render={background: true, background: true}", "render.background: repeated key"),
    ],
)
def test_overrides_that_lead_nowhere(refusal: Refusal, override: str, problem: str):
    (line,) = refusal(SCENE, override)
    assert line == problem if line.startswith(problem) else problem in line


def test_json_is_a_scene_too(tmp_path: Path, read: Read):
    tree = yaml.safe_load(SCENE)
    tree["lights"][0]["irradiance"] = 3.141592653589793
    tree["diffusion"] = {"tolerance": 1e-05}
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(tree, indent=1))
    loaded = read_scene(path).tree
    assert loaded.diffusion.tolerance == 1e-05 and loaded.lights[0] == DirectionalSection(
        (-2, -2, -1), 3.141592653589793
    )
    assert loaded.volume == read(SCENE).tree.volume


def test_marks_lead_later_errors_to_the_line(read: Read):
    scene_file = read(SCENE, "volume.g=0.1")
    assert str(scene_file.refused("lights.1.radiance", "odd")).endswith(
        "scene.yaml:10:31: lights.1.radiance: odd"
    )
    assert str(scene_file.refused("views.0.image.never.written", "odd")).endswith(
        "scene.yaml:12:5: views.0.image.never.written: odd"
    )
    assert str(scene_file.refused("volume.g", "odd")) == "-D volume.g=0.1: volume.g: odd"


@pytest.mark.parametrize("text", [SCENE, CONTRACT, with_matrix(RIGID)])
def test_a_dumped_scene_reads_back_as_the_same_tree(read: Read, text: str, tmp_path: Path):
    overrides = [
        "views.0.name='1e5'",
        "optimize.parameters.density={init: {file: a b.npz}, max: 7}",
        "diffusion.tolerance=1e-5",
    ]
    scene_file = read(text, *overrides)
    (tmp_path / "elsewhere").mkdir()
    dump_scene(scene_file, tmp_path / "elsewhere" / "scene.yaml")
    assert read_scene(tmp_path / "elsewhere" / "scene.yaml").tree == scene_file.tree


def test_a_dump_has_every_default(read: Read):
    described = describe(read(SCENE))
    defaults = dataclasses.asdict(DiffusionSettings())
    assert described["diffusion"] == {k: v for k, v in defaults.items() if v is not None}
    assert described["views"][0]["camera"]["up"] == [0, 1, 0]
    assert "optimize" not in described and "matrix" not in described["views"][0]["camera"]


def test_problems_are_in_the_order_of_the_file(refusal: Refusal):
    lines = refusal(
        SCENE.replace("g: 0.3", "g: 2").replace("0.6", "-1").replace("fov: 28", "fov: 0")
    )
    assert [line.split(":")[1] for line in lines] == ["5", "7", "12"]


def test_what_a_record_is_is_found_out_once(read: Read):
    """So that thousands of views are read quickly: no annotation is evaluated again."""
    read(SCENE)
    called = set[str]()
    sys.setprofile(lambda frame, event, _: called.add(frame.f_code.co_qualname))
    try:
        read(SCENE)
    finally:
        sys.setprofile(None)
    assert "read_record" in called and "get_type_hints" not in called
