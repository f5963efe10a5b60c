"""Held-out views, registered: a camera and an exposure that are off by a known change are found."""

from dataclasses import replace

import pytest
import torch
from media import box_grid, make_camera, make_scene, random_values

from ddrecon.cameras import project, twist
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.picture import view_picture
from ddrecon.run.quality import register, shift_between


@pytest.mark.parametrize("loss", ["l2", "display"])
def test_a_camera_that_is_off_is_found(loss: str) -> None:
    camera = make_camera(size=(40, 40), half_width=0.28)
    density = torch.nn.functional.avg_pool3d(random_values(1, 16, 16, 16), 5, 2)[0]
    scene = make_scene(density, camera=camera, sigma_a=(2.0,), sigma_s=(3.0,))
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


def test_a_shift_is_that_of_the_smoke_and_of_no_empty_cell() -> None:
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
    for scene in (make_scene(density, grid=grid), make_scene(padded, grid=around)):
        found = shift_between(camera, moved, scene.volume)
        assert found == pytest.approx((0.5 * one + 1.5 * other) / 2)
