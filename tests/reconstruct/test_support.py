"""Support: no medium where a view that sees a cell sees nothing, and none comes back there."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from media import box_grid, make_camera, tensor

from ddrecon.cameras import cast_rays, project
from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.hull import find_shown, hull_of
from ddrecon.pictures import decode
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.support import Support, describe_support, support_text
from ddrecon.scene import View
from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"
CAMERAS = {
    "pinhole": make_camera(size=(30, 36)),
    "oblong": replace(make_camera(size=(30, 36)), principal_point=(0.4, 0.55), pixel_aspect=1.2),
    "parallel": make_camera(size=(30, 36), half_width=0.7, is_perspective=False),
}
LENSES = {"opencv": tensor(-0.2, 0.05, 0, 0, 0.002, -0.001), "fisheye": tensor(0.02, -0.01, 0, 0)}
WIDE = make_camera(eye=(0.1, 0.2, 0.9), size=(30, 36), half_width=1.2)
CAMERAS["opencv"] = replace(CAMERAS["pinhole"], lens="opencv", distortion=LENSES["opencv"])
CAMERAS["fisheye"] = replace(WIDE, lens="fisheye", distortion=LENSES["fisheye"])


@pytest.mark.parametrize("name", CAMERAS)
def test_projection_is_the_inverse_of_casting_rays(name):
    """A point on a pixel's ray is seen at the pixel's center, as far off as it was put."""
    camera = CAMERAS[name]
    rays = cast_rays(camera)
    far = torch.linspace(0.5, 3, len(rays.direction), dtype=torch.float64)
    points = (rays.origin + far[:, None] * rays.direction).flip(1)
    places, distance = project(camera, points)
    height, width = camera.size
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    expected = torch.stack([columns, rows], -1).view(-1, 2) + 0.5
    torch.testing.assert_close(places, expected.double(), rtol=0, atol=1e-9)
    if camera.is_perspective:
        torch.testing.assert_close(distance, far, rtol=1e-12, atol=0)


def test_what_lies_behind_or_far_outside_is_not_seen():
    """Also where a polynomial would fold it back into the image."""
    camera = replace(CAMERAS["opencv"], distortion=torch.tensor([-0.5, 0, 0, 0, 0, 0]).double())
    backward, origin = camera.pose[:, 2], camera.pose[:, 3]
    right = camera.pose[:, 0]
    points = torch.stack([origin + backward, origin - backward + math.sqrt(2) * right])
    assert project(camera, points)[0].isnan().all()


@pytest.mark.parametrize("name", CAMERAS)
def test_a_hull_holds_every_cell_that_a_shown_pixel_looks_through(name):
    """Rays of pixels that show something cross only the hull; with nothing shown none stays."""
    camera, grid = CAMERAS[name], box_grid((7, 6, 8))
    shown = torch.rand(camera.size, generator=torch.Generator().manual_seed(1)) > 0.995
    held, seen = hull_of(camera, shown, grid, 0.0)
    hull = held | ~seen
    rays = cast_rays(camera)
    low, high = (torch.tensor(corner).double() for corner in (grid.lower, grid.upper))
    for index in shown.flatten().nonzero()[:, 0].tolist():
        steps = torch.linspace(0, 4, 400, dtype=torch.float64)[:, None]
        points = rays.origin[index] + steps * rays.direction[index]
        inside = points[((points > low) & (points < high)).all(1)]
        cells = ((inside - low) / torch.tensor(grid.spacing).double()).long()
        assert bool(hull[tuple(cells.unbind(1))].all())
    assert not bool(hull.all())
    assert not hull_of(camera, torch.zeros_like(shown), grid, 0.0)[0].any()
    everything, is_seen = hull_of(camera, torch.ones_like(shown), grid, 0.0)
    z, y, x = torch.meshgrid(*(c.flatten() for c in grid.centers(camera.pose)), indexing="ij")
    places, _ = project(camera, torch.stack([x, y, z], -1).view(-1, 3))
    size = torch.tensor([camera.size[1], camera.size[0]])
    seen = ((places >= 0) & (places < size)).all(1)
    assert bool(everything.all()) and torch.equal(is_seen.flatten(), seen)


def test_a_hull_grows_with_margin_and_with_cells():
    camera = CAMERAS["pinhole"]
    shown = torch.zeros(camera.size, dtype=torch.bool)
    shown[15, 18] = True
    grids = [box_grid((8, 8, 8)), box_grid((4, 4, 4))]
    hulls = [hull_of(camera, shown, grids[0], margin)[0] for margin in (0.0, 1.0, 4.0)]
    for small, large in pairwise(hulls):
        assert bool((large | ~small).all()) and large.sum() > small.sum()
    coarse, _ = hull_of(camera, shown, grids[1], 0.0)
    fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    _, is_seen = hull_of(camera, shown, grids[0], 0.0)
    assert bool((fine | ~(hulls[0] & is_seen)).all())


def ball(*overrides):
    return load_scene(BALL, overrides=["optimize.iterations=8", *overrides])


@pytest.mark.slow
def test_outside_of_its_support_a_volume_stays_empty(monkeypatch):
    """At every level, whatever `min` says, and rays know it; and the ball itself is inside."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", 6)
    scene = ball("optimize.parameters.density={support: masks, support_margin: 1, min: 0.01}")
    for view in scene.views:
        view.mask = (view.image.amax(0) > 0.26).to(view.image)
    run = Reconstruction(scene)
    assert run.problem.support is not None
    grids = set()
    while not run.is_done:
        run.step()
        (density,) = run.parameters
        hull = run.problem.support.on(density.grid)
        grids.add(density.grid)
        assert not density.value[~hull].any() and density.value[hull].min() >= 0.01
        assert torch.equal(run.level.train.volume.support, hull)
        assert 0.1 < float(hull.float().mean()) < 1
    assert len(grids) > 1
    truth = np.load(BALL.parents[1] / "data" / "ball" / "density.npz")["density"]
    assert truth[~hull.numpy()].sum() < 0.03 * truth.sum()


@pytest.mark.parametrize("read", [0.002, 0.01])
def test_auto_tells_black_from_faint_smoke_by_the_noise(read):
    """Black is not shown but for one pixel in a thousand; what is 8 deviations above it is."""
    generator = torch.Generator().manual_seed(3)
    image = 0.02 + read * torch.randn(3, 120, 90, generator=generator)
    faint = torch.zeros(120, 90, dtype=torch.bool)
    faint[40:80, 30:60] = True
    image[:, faint] += 8 * read
    shown = find_shown(View("", CAMERAS["pinhole"], image), "auto")
    assert shown[faint].float().mean() > 0.99 and shown[~faint].float().mean() < 0.001


def speckle(block, share):
    """[320, 320]: 1 to 3 in this `share` of pixels, half of some blocks, and 0 in others."""
    generator = torch.Generator().manual_seed(2)
    values = torch.randint(1, 4, (320, 320), generator=generator).float()
    shape = (320 // block, 320 // block)
    within = 1.0 if block == 1 else 0.5
    blocks = torch.rand(shape, generator=generator) < share / within
    blocks = blocks.repeat_interleave(block, 0).repeat_interleave(block, 1)
    return values * blocks * (torch.rand(320, 320, generator=generator) < within)


@pytest.mark.parametrize(
    ("uneven", "block", "share"),
    [(0, 1, 0.01), (0, 4, 0.01), (0, 1, 0.2), (50, 1, 0)],
)
def test_auto_takes_no_noise_of_compression_for_smoke(uneven, block, share):
    """A picture of 8 bits shows a cloud, how `uneven` it may be, its faint stem, and no noise."""
    y, x = torch.arange(320)[:, None], torch.arange(320)
    cloud = (x - 160) ** 2 + (y - 120) ** 2 < 80**2
    stem = (y > 200) & ((x - 160).abs() < 4) & (y < 300)
    # Uneven where it is thin.
    core = (x - 160) ** 2 + (y - 120) ** 2 < 50**2
    thin = 80 + uneven * torch.sin(2 * x) * torch.sin(2 * y)
    bright = torch.where(core, 220, torch.where(cloud, thin, 7.0 * stem))
    encoded = torch.maximum(bright.round(), speckle(block, share)) / 255
    image = torch.from_numpy(decode(encoded.numpy())).float().expand(3, -1, -1)
    shown = find_shown(View("", CAMERAS["pinhole"], image, step=1 / 255), "auto")
    assert bool(shown[cloud | stem].all())
    away = torch.nn.functional.max_pool2d((cloud | stem).float()[None], 9, 1, 4)[0] == 0
    assert float(shown[away].float().mean()) < 2e-4


@pytest.mark.parametrize(("shift", "lonely"), [(0, 0), (0.5, 0.5), (1, 1)])
def test_cells_that_one_view_sees_are_told(shift, lonely):
    """Of two parallel cameras beside each other, by a part of the box, each sees a part alone."""
    grid = Grid((4, 4, 8), (-0.5,) * 3, (0.5,) * 3)
    camera = make_camera((0, 0, 2.5), (8, 8), half_width=0.5, is_perspective=False)
    pose = camera.pose.clone()
    pose[0, 3] += shift
    views = [View("one", camera), View("other", replace(camera, pose=pose))]
    shown = [torch.ones(8, 8, dtype=torch.bool)] * 2
    described = describe_support([Support(views, shown, 0.0)], grid)
    assert described["lonely"] == lonely
    assert ("ghosts" in support_text(described)) == (lonely > 0)


def refusal(scene):
    with pytest.raises(SceneError) as caught:
        Reconstruction(scene)
    (line,) = caught.value.problems
    return line


def test_masks_that_empty_the_hull_are_refused_in_one_line():
    scene = ball("optimize.parameters.density={support: masks, support_margin: 0}")
    views = []
    for index, view in enumerate(scene.views):
        mask = torch.zeros(32, 32)
        mask[4:6, 14:18] = float(index != 1)
        mask[26:28, 14:18] = float(index == 1)
        views.append(replace(view, mask=mask))
    line = refusal(replace(scene, views=views))
    assert "no cell is left" in line and "support_margin" in line
    masks = (torch.full((32, 32), float(index != 1)) for index in range(len(scene.views)))
    views = [replace(view, mask=mask) for view, mask in zip(scene.views, masks, strict=True)]
    assert "shows nothing at all, by its mask" in refusal(replace(scene, views=views))


def test_what_is_no_support_is_refused():
    with pytest.raises(SceneError, match=r"g\.support: 'masks' is for density alone"):
        ball("optimize.parameters.g={support: masks}")
