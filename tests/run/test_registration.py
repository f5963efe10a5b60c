"""Held-out views, registered: a camera and an exposure that are off by a known change are found."""

from dataclasses import replace

import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.cameras import twist
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.renderer import solve_light, view_picture
from ddrecon.run.registration import register, shift_between


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
    true = shift_between(camera, moved, scene.volume.grid)
    assert true > 0.5 and abs(found["shift"] - true) < 0.15 * true
