"""The view-ray integral by fused kernels is torch's, in values, adjoints and tangents."""

import pytest
import torch
from graphics_cards import assert_compiles
from media import half_empty, make_camera, make_scene, random_values
from twins import assert_render_twins, differentiate, images_of, values_of

from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.light.lights import PointLight
from ddrecon.medium.phase import Blend, HenyeyGreenstein, Rayleigh, TwoLobe

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.march.fused import kernels
from ddrecon.march.fused.cells import Cells
from ddrecon.march.fused.kernels import Case, Layout

pytestmark = pytest.mark.slow

SHAPE = (7, 9, 8)
OUTSIDE, INSIDE = {"half_width": 0.4}, {"eye": (0.1, 0.12, 0.05), "half_width": 0.6}
LIGHT = ["density", "g", "lights.0.irradiance", "lights.0.direction"]
POINT = ["lights.1.position", "lights.1.intensity"]
POSE = ["views.view.camera"]


def scene_of(kind, view, dtype=torch.float64, size=9):
    """A scene with a directional light, `kind` of medium and lights, seen by one camera."""
    density = half_empty(*SHAPE, dtype=dtype)
    tensor, camera = density.new_tensor, make_camera(size=(size, size + 1), dtype=dtype, **view)
    sigma_a, sigma_s = (0.5 + random_values(3, *SHAPE, seed=k, dtype=dtype) for k in (1, 2))
    outside = PointLight(tensor([0.9, 0.7, 0.2]), tensor([1.0, 2.0, 0.5]))
    both = [outside, PointLight(tensor([0.1, 0.05, -0.1]), tensor([0.3]))]
    medium, lights = {
        "gray": ({"sigma_a": (1.0,), "sigma_s": (6.0,)}, []),
        "backward": ({"g": -0.4, "ambient": (0.2, 0.1, 0.3)}, []),
        "peaked": ({"g": 0.5}, []),
        "points": ({"g": -0.3}, both),
        "fields": ({"g": 0.5, "sigma_a": sigma_a, "sigma_s": 6 * sigma_s}, both),
        "lobes by color": ({}, [outside]),
        "weight by cell": ({}, [outside]),
    }.get(kind, ({}, []))
    scene = make_scene(density, camera=camera, **medium)
    scene.lights += lights
    scene.volume.phase = phases(density).get(kind, scene.volume.phase)
    return scene


def phases(density):
    """Both signs of g; two lobes, by color or backward; or weights that colors share."""
    tensor, numbers = density.new_tensor, random_values(*SHAPE, seed=7, dtype=density.dtype)
    by_color = random_values(3, *SHAPE, seed=8, dtype=density.dtype)
    haze, air = HenyeyGreenstein(tensor([0.6, 0.5, -0.3])), Rayleigh(density.new_zeros(()))
    return {
        "lobes by color": TwoLobe(tensor([0.6, -0.4]), tensor([0.9, 0.5, 0.2])),
        "g by cell": HenyeyGreenstein(1.6 * numbers - 0.7),
        "weight by cell": TwoLobe(tensor([0.6, -0.4]), by_color),
        "blend by cell": Blend(haze, air, numbers),
        "backward weight by cell": TwoLobe(tensor([-0.2, -0.5]), numbers),
    }


EMISSIONS = [
    ("gray", OUTSIDE, [*LIGHT, "sigma_t", *POSE]),
    ("backward", OUTSIDE, [*LIGHT, "albedo"]),
    ("fields", OUTSIDE, [*LIGHT, *POINT, "sigma_a", "sigma_s", *POSE]),
    ("weight by cell", INSIDE, ["density", "phase.weight", *POINT, *POSE]),
    # With all rays where they are, packets of them are marched back.
    ("gray", OUTSIDE, ["density", "g", "sigma_a", "sigma_s"]),
    ("peaked", OUTSIDE, [*LIGHT, "sigma_s"]),
    ("points", OUTSIDE, ["density", "g", "sigma_a", "sigma_s", "lights.1.intensity"]),
    ("lobes by color", OUTSIDE, ["density", "phase.g", "phase.weight", *POINT, *POSE]),
    # Where the phase function differs from cell to cell.
    ("g by cell", OUTSIDE, ["density", "g", *POSE]),
    ("g by cell", OUTSIDE, [*LIGHT, "sigma_s"]),
    ("weight by cell", OUTSIDE, ["density", "phase.g", "phase.weight", *POINT]),
    ("blend by cell", OUTSIDE, ["density"]),
    ("backward weight by cell", OUTSIDE, [LIGHT[0], "phase.g", "phase.weight", LIGHT[-1]]),
]


@pytest.mark.parametrize(
    ("kind", "view", "names"),
    EMISSIONS,
    ids=[
        f"{kind}-{'in' if view is INSIDE else 'out'}side-{names[-1]}"
        for kind, view, names in EMISSIONS
    ],
)
def test_images_and_derivatives_are_those_of_torch(kind, view, names):
    """With tangents of the media whose tangents `tests/test_engines.py` does not try."""
    has_tangent = kind == "lobes by color" or "by cell" in kind
    assert_render_twins(scene_of(kind, view), names, has_tangent=has_tangent)


def test_lattices_of_rays_are_marched_as_well():
    """As many pixels as make the renderer interpolate most of them."""
    assert_render_twins(scene_of("peaked", OUTSIDE, size=64), ["density"])


@pytest.mark.parametrize("eye", [(0.3, 0.4, 3.0), (3.0, 0.5, 0.2), (0.2, -3.0, -0.4)], ids=str)
@pytest.mark.parametrize(
    ("dtype", "half_width"), [(torch.float32, 0.2), (torch.float64, 0.4)], ids=str
)
def test_packets_read_and_write_whole_rows(eye, dtype, half_width):
    """From all sides, of a volume as wide as a packet: its lanes share rows, or columns, of it."""
    camera = make_camera(size=(24, 33), dtype=dtype, half_width=half_width, eye=eye)
    scene = make_scene(half_empty(18, 21, 19, dtype=dtype), g=0.5, camera=camera)
    error = 1e-5 if dtype is torch.float32 else 1e-12
    assert_render_twins(scene, ["density", "sigma_s"], error)


@pytest.mark.parametrize("eye", [(0.0, 0.0, 3.0), (3.0, 0.0, 0.0), (0.3, 3.0, 0.2)], ids=str)
def test_derivatives_by_rays_through_centers_of_cells(eye):
    """There slopes are those beyond centers; from all sides, by packets of rows or columns."""
    is_slanted = eye[1] != 0
    camera = make_camera(size=(9, 7), half_width=0.3, eye=eye, is_perspective=is_slanted)
    grid = Grid((9, 7, 9), (-0.5, -0.6, -0.4), (0.5, 0.6, 0.4))
    medium = {"sigma_a": (1.0,), "sigma_s": (6.0,)}
    scene = make_scene(half_empty(*grid.shape), camera=camera, grid=grid, **medium)
    assert_render_twins(scene, ["density", *POSE])
    assert_render_twins(scene, POSE, has_tangent=True)


def test_kernels_compile_for_graphics_cards(tmp_path):
    """Some of all kernels: each takes seconds."""
    layout = Layout(1, 1, 1, 0, 0, 0, 0, 0, 1, 1, False, (False, True), 32)
    several = Layout(3, 3, 3, 3, 3, 3, 1, 3, 3, 4, False, (False, True), 64)
    by_g = Layout(1, 1, 1, 0, 0, 1, 1, 1, 1, 12, True, (True,), 32)
    packets = [
        kernels.integral_kernel(by_g, False),
        kernels.tangent_kernel(layout, Case(False, True)),
        kernels.adjoint_kernel(several, Case(False), "long"),
    ]
    assert_compiles(packets, tmp_path)


def test_places_beyond_the_numbers_of_an_int_are_refused():
    planes, rays, shape = torch.zeros(2), torch.zeros(1, 8), (3, 2048, 1024, 1024)
    order = torch.zeros(2, dtype=torch.int32)
    assert Cells(planes, 0, order).arguments(rays, shape)["plane_stride"] == 2**20
    for cells in (Cells(planes), Cells(planes, 1, order)):
        with pytest.raises(UsageError, match=r"2\^31"):
            cells.arguments(rays, shape)


def test_empty_space_and_rays_that_miss():
    """Nothing is seen, and derivatives by the density of empty cells are finite and not zero."""
    scene = scene_of("gray", {"half_width": 0.7})
    scene.volume.density = torch.zeros_like(scene.volume.density)
    assert_render_twins(scene, ["density"])
    found = differentiate("warp", images_of(scene), values_of(scene, ["density"]))
    image, bar = found.values()
    assert not image.any() and bool(torch.isfinite(bar).all()) and bool(bar.any())
