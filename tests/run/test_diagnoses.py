"""Each diagnosis is made of a scene that has the fault, and of none of the others."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from media import box_grid, make_camera, random_values
from media import make_scene as plain_scene

from ddrecon.cameras import project, twist
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.picture import render, view_picture
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.support import Support
from ddrecon.run.quality import (
    Findings,
    best_shift,
    diagnose,
    find_odd,
    find_results,
    find_unfinished,
    register,
    shift_between,
)
from ddrecon.scene import View
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"
SMALL = (
    "volume.resolution=[8, 8, 8]",
    "optimize.parameters.density.tv=0.1",
    "diffusion={model: none}",
    "lights=[{type: directional, direction: [-1, -2, -1], irradiance: 3}]",
    *(f"views.{i}.camera.resolution=[14, 14]" for i in range(7)),
    *(f"views.{i}.image=null" for i in range(7)),
)


def make_scene(*overrides):
    """The ball's views, small, of a lopsided blob with noise; the density starts near the truth."""
    scene = load_scene(BALL, overrides=(*SMALL, *overrides))
    z, y, x = scene.volume.grid.centers(scene.volume.density)
    blob = torch.exp(-((x - 0.05) ** 2 + 2 * (y + 0.1) ** 2 + (z + 0.05) ** 2) / 0.05)
    with torch.no_grad():
        truth = with_values(scene, {"density": blob})
        images = render(truth)
        images = images + 0.1 * images.mean() * torch.randn(images.shape)
    views = [replace(view, image=image) for view, image in zip(scene.views, images, strict=True)]
    starts = scene.starts | ({"density": 0.8 * blob} if "density" in scene.starts else {})
    return replace(scene, views=views, volume=truth.volume, starts=starts)


def kinds(scene, iterations=60):
    """The kinds of diagnoses of a reconstruction of `scene`."""
    return kinds_at(scene, iterations)[-1]


def kinds_at(scene, *stops):
    """The same of one that is looked at after so many iterations, and ends after the last."""
    run, told = Reconstruction(scene, stops[-1]), []
    while not run.is_done:
        run.step()
        if run.iteration not in stops and not run.is_done:
            continue
        diagnoses = diagnose(find_results(run), run.iteration, run.search.gain)
        told.append([each["kind"] for each in diagnoses])
    return told


def expose(scene):
    scene.views[2].image = scene.views[2].image * 1.6


def move(scene):
    change = torch.tensor([0.0, 0, 0, 0.12, 0, 0])
    camera = scene.views[3].camera
    scene.views[3].camera = twist(camera, change, scene.volume.grid.center_xyz)


def keep_one(scene):
    scene.views[1:-1] = []
    start_empty(scene)


def start_empty(scene):
    scene.starts["density"] = torch.zeros(scene.volume.grid.shape)


FAULTS = {"clean": (lambda scene: None, 24), "exposure": (expose, 24), "cameras": (move, 24)}
FAULTS |= {"overfit": (keep_one, 50), "unfinished": (start_empty, 5), "empty": (start_empty, 1)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_is_told_and_no_other(kind):
    fault, iterations = FAULTS[kind]
    scene = make_scene()
    fault(scene)
    assert kinds(scene, iterations) == [kind] * (kind != "clean")


def findings_of(scene):
    """What each view of `scene` shows, all equally well."""
    with torch.no_grad():
        images = {view.name: render(scene, view.name)[0] for view in scene.views}
    return Findings(scene, {}, images, {view.name: {"psnr": 30.0} for view in scene.views})


AT_REST = 60, 0.0
"""The iterations of a run that has come to rest, and what its loss can still fall by."""


@pytest.mark.parametrize(
    ("gain", "advice"), [(math.inf, "--resume"), (0.0, "directions of lights")]
)
def test_why_a_volume_is_empty_is_told(gain, advice):
    """Nothing else is: what is not there is neither overfit nor seen from a wrong side."""
    scene = make_scene()
    views = [replace(view, is_test=view.name == "ring_01") for view in scene.views]
    nothing = with_values(replace(scene, views=views), {"density": 1e-7 * scene.volume.density})
    (told,) = diagnose(findings_of(nothing), 3, gain)
    assert told["kind"] == "empty" and advice in told["text"]
    glowing = replace(scene.volume, density=nothing.volume.density, emission=torch.ones(1, 8, 8, 8))
    seen = findings_of(replace(nothing, volume=glowing))
    assert "empty" not in [each["kind"] for each in diagnose(seen, 3, gain)]


@pytest.mark.parametrize(("misfit", "kinds"), [(3.0, []), (5.0, ["unexplained"])])
def test_pictures_that_a_run_at_rest_does_not_explain_are_told(misfit, kinds):
    diagnoses = diagnose(findings_of(make_scene()), *AT_REST, misfit=misfit)
    assert [diagnosis["kind"] for diagnosis in diagnoses] == kinds


@pytest.mark.parametrize("rows", [0, 4])
def test_what_a_support_cuts_off_is_told_with_the_view_that_does(rows):
    """One of seven cameras is off by some rows, so that it shows nothing where the others do."""
    scene = make_scene()
    shown = [view.image.amax(0) > 0.3 * view.image.max() for view in scene.views]
    shown[3] = torch.roll(shown[3], -rows, 0)
    support, grid = Support(scene.views, shown, 0.0), scene.volume.grid
    found = with_values(scene, {"density": scene.volume.density * support.on(grid)})
    diagnoses = diagnose(findings_of(found), *AT_REST, support)
    texts = [each["text"] for each in diagnoses if each["kind"] == "support"]
    assert len(texts) == (rows > 0)
    assert all(f"check camera {scene.views[3].name}, which alone" in text for text in texts)


def test_a_camera_is_told_though_a_volume_fitted_to_all_hides_most_of_it():
    """A render that is moved would fit a decibel better, by a quarter of what it leaves."""
    scene = make_scene("volume.resolution=[16, 16, 16]")
    images = findings_of(scene).images
    for view in scene.views:
        view.image = images[view.name].clone()
    wrong, image = scene.views[2], images[scene.views[2].name]
    slope = torch.roll(image, 1, 2) - image
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    wrong.image = image + 2 * slope + noise * 2 * slope.square().mean().sqrt() * 3.5**0.5
    (right, down), explained = best_shift(wrong, image)
    assert 0.2 < explained < 0.3 and abs(down) < 0.5 < right
    (told,) = diagnose(Findings(scene, {}, images, findings_of(scene).quality), *AT_REST)
    assert told["kind"] == "cameras" and wrong.name in told["text"]


SIDE = (
    "lights=[{type: directional, direction: [-1, 0, 0.2], irradiance: 3}]",
    "volume.sigma_s=[20, 30, 40]",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("begin", "scene"), [(lambda scene: None, ()), (start_empty, SIDE)], ids=["near", "far"]
)
def test_nobody_is_accused_of_what_going_on_would_mend(begin, scene):
    """On correct scenes, at any time; a picture exposed otherwise is told at the end."""
    right, wrong = make_scene(*scene), make_scene(*scene)
    wrong.views[2].image = 1.5 * wrong.views[2].image
    begin(right)
    begin(wrong)
    for told in kinds_at(right, 3, 15, 40):
        assert {*told} <= {"unfinished"}
    assert kinds(wrong, 40) == ["exposure"]


def blob(right=0.0, down=0.0):
    """A smooth picture, moved by so many pixels."""
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    return torch.exp(-((x - 24 - right) ** 2 + (y - 19 - down) ** 2) / 60).expand(3, -1, -1)


def views_of(**images):
    mask = (torch.arange(50) > 5).float().expand(40, 50)
    return [View(name, None, image=x, mask=mask) for name, x in images.items()]  # type: ignore[arg-type]


@pytest.mark.parametrize("move", [(0.3, -0.2), (-0.15, 0.25)])
def test_the_shift_of_a_smooth_picture_is_found(move):
    """To first order: a picture and its copy a part of a pixel to the right and down."""
    (view,) = views_of(front=blob(*move))
    found, explained = best_shift(view, blob())
    assert found == pytest.approx(move, abs=0.01) and explained > 0.99


def test_a_held_out_picture_is_compared_by_its_own_exposure():
    """Where exposures are found, twice as bright a picture is as well explained."""
    rows = []
    for factor in (1.0, 2.0):
        torch.manual_seed(0)
        scene = make_scene("optimize.parameters.views.train_0.exposure={}")
        (view,) = (view for view in scene.views if view.is_test)
        view.image = factor * view.image
        run = Reconstruction(scene, 1)
        run.step()
        rows.append(find_results(run).quality[view.name])
    assert rows[1]["psnr"] == pytest.approx(rows[0]["psnr"], abs=1e-3)
    one, other = (torch.tensor(row["fitted_exposure"]) for row in rows)
    torch.testing.assert_close(other, 2 * one, rtol=1e-3, atol=0)


GAINS = {"a": 1.1, "b": 1.2, "c": 0.5, "d": 1.5, "e": 1 / 1.1, "f": 0.8, "g": 1.9}
MOVES = {"a": 0.4, "b": 0.6, "c": 1.3, "d": -1.0, "e": 0.8, "f": -1.1}


@pytest.mark.parametrize(
    ("views", "told"),
    [
        (views_of(**{name: gain * blob() for name, gain in GAINS.items()}), "cgfd"),
        (views_of(a=1.1 * blob(), b=1.2 * blob(), c=blob() / 1.1, d=blob() / 1.3), "db"),
        (views_of(a=1.1 * blob(), c=blob() / 1.1), ""),
        (views_of(**{name: blob(right) for name, right in MOVES.items()}), "cfde"),
        (views_of(a=blob(0.4), b=blob(0.3, 0.5)), "b"),
        (views_of(a=blob(0.4), b=blob(0.3, 0.3)), ""),
    ],
)
def test_what_is_off_by_15_percent_or_half_a_pixel_is_told_the_four_worst_first(views, told):
    images = {view.name: blob() for view in views}
    texts = " ".join(find_odd(views, images, 0.0).values())
    found = "".join(re.findall(r"(\w) \([0-9.]+ (?:times|pixels)\)", texts))
    assert found == told


@pytest.mark.parametrize("loss", ["l2", "display"])
def test_a_camera_that_is_off_is_found(loss):
    camera = make_camera(size=(40, 40), half_width=0.28)
    density = torch.nn.functional.avg_pool3d(random_values(1, 16, 16, 16), 5, 2)[0]
    scene = plain_scene(density, camera=camera, sigma_a=(2.0,), sigma_s=(3.0,))
    change = torch.tensor([0.02, -0.03, 0.01, 0.015, -0.02, 0.02]).double()
    moved = twist(camera, change, scene.volume.grid.center_xyz)
    with torch.no_grad():
        lit = solve_light(scene, SolveMemory())
        image = 0.8 * view_picture(lit, scene, replace(scene.views[0], camera=moved))
        view = replace(scene.views[0], image=image, is_test=True)
        scene = replace(scene, views=[view])
        target = Target.of(image, None, loss)
        as_is = target.psnr_of(view_picture(lit, scene, view))
        found = register(lit, scene, view, target, {})
    assert found["psnr"] > as_is + 15
    true = shift_between(camera, moved, scene.volume)
    assert true > 0.5 and abs(found["shift"] - true) < 0.15 * true


def test_a_shift_is_that_of_the_smoke_and_of_no_empty_cell():
    """Of two puffs, as much as each extinguishes; a box twice as wide around them changes none."""
    camera = make_camera(size=(40, 40), half_width=0.6)
    moved = twist(camera, torch.tensor([0.02, -0.03, 0.01, 0.015, -0.02, 0.02]).double(), (0, 0, 0))
    grid, cells, places = box_grid((6, 4, 8)), [(1, 2, 6), (4, 0, 1)], []
    density = torch.zeros(grid.shape).double()
    for cell, value in zip(cells, (0.5, 1.5), strict=True):
        density[cell] = value
        steps = zip(grid.lower, grid.spacing, cell, strict=True)
        places.append([low + (at + 0.5) * step for low, step, at in steps][::-1])
    seen = [project(each, torch.tensor(places).double())[0] for each in (camera, moved)]
    one, other = (seen[0] - seen[1]).norm(dim=1).tolist()
    sides = zip(grid.lower, grid.upper, strict=True)
    around = Grid(
        (12, 8, 16), *zip(*((1.5 * a - 0.5 * b, 1.5 * b - 0.5 * a) for a, b in sides), strict=True)
    )
    padded = torch.nn.functional.pad(density, (4, 4, 2, 2, 3, 3))
    for scene in (plain_scene(density, grid=grid), plain_scene(padded, grid=around)):
        found = shift_between(camera, moved, scene.volume)
        assert found == pytest.approx((0.5 * one + 1.5 * other) / 2)


def test_a_camera_that_has_lost_the_smoke_was_moved_across_its_picture():
    camera, scene = make_camera(size=(30, 40)), plain_scene(torch.ones(4, 4, 4).double())
    away = replace(camera, pose=camera.pose * camera.pose.new_tensor([-1, 1, -1, 1]))
    assert shift_between(camera, away, scene.volume) == 50


@pytest.mark.parametrize(
    ("gain", "much"), [(0.7, "half"), (0.2, "some 20 %"), (0.05, ""), (math.inf, "")]
)
def test_a_run_is_unfinished_where_a_tenth_is_to_go(gain, much):
    """As the search has it, where it is not too short to tell."""
    told = find_unfinished(gain, 100)
    assert (told is not None) == bool(much)
    assert told is None or (much in told and "--iterations 200" in told)
