"""View rays: closed forms, and plain sums of E2.1 to E2.3 on other nodes."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import (
    box_grid,
    convergence_order,
    half_empty,
    make_camera,
    make_scene,
    march_rays,
    random_values,
    summed_series,
    tensor,
)
from scenes import VIEWS
from torch.nn.functional import grid_sample, pad

from ddrecon.cameras import Rays, cast_rays, subpixel_offsets
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.light.reduced import follow_lights
from ddrecon.lighting import send, solve_light
from ddrecon.march import integral as march_module
from ddrecon.march.faces import extend_fields
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import choose_sampling, cross_box, intersect_box
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, SeenPhase, TwoLobe
from ddrecon.numerics.interpolation import ThirdOrder
from ddrecon.picture import render
from ddrecon.settings import RenderSettings

each_camera = pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())


def emission_of(grid, density):
    """A medium under one oblique beam and some smooth diffuse light that grows along x."""
    light = DirectionalLight(density.new_tensor([0.3, -1.0, -0.5]), density.new_tensor([2.0]))
    numbers = map(density.new_tensor, ([0.5], [2.0, 3.0], 0.3))
    medium = scale_medium(Volume(grid, density, *numbers))
    diffuse = (1 + grid.centers(density)[2]).expand(2, *grid.shape)
    matter, beams = (medium.extinction, medium.scattering), follow_lights(medium, [light])
    return OutgoingLight(grid, *matter, beams, diffuse, medium.seen, medium.peak)


def every_ray(steps):
    """Settings by which all rays are marched themselves."""
    return RenderSettings(steps_per_voxel=steps, tolerance=0.0)


def chord(grid, origin, direction):
    """The length of one ray inside the box, in front of its origin, face by face."""
    near, far = 0.0, math.inf
    for low, high, o, d in zip(grid.lower, grid.upper, origin, direction, strict=True):
        if d == 0 and not low < o < high:
            return 0.0
        if d != 0:
            near = max(near, min((low - o) / d, (high - o) / d))
            far = min(far, max((low - o) / d, (high - o) / d))
    return max(far - near, 0.0)


def chords(grid, bundle):
    pairs = zip(bundle.origin.tolist(), bundle.direction.tolist(), strict=True)
    return bundle.origin.new_tensor([chord(grid, *pair) for pair in pairs])


@each_camera
@pytest.mark.parametrize("steps", [1, 3])
def test_a_homogeneous_box_attenuates_by_its_chord(view, steps):
    grid, bundle = box_grid((3, 5, 4)), cast_rays(make_camera(size=(7, 6), **view))
    outgoing = emission_of(grid, torch.full(grid.shape, 0.7, dtype=torch.float64))
    transmittance = march_rays(outgoing, bundle, every_ray(steps))[1]
    lengths = chords(grid, bundle)
    assert bool((lengths > 0).any())
    expected = torch.exp(-outgoing.extinction.value[:, 0, 0, :1] * lengths)
    torch.testing.assert_close(transmittance, expected, rtol=1e-12, atol=0)


@each_camera
def test_rays_that_miss_the_box_see_nothing(view):
    grid = box_grid((3, 5, 4))
    bundle = cast_rays(make_camera(size=(7, 6), **(view | {"half_width": 5.0})))
    outgoing = emission_of(grid, 0.1 + half_empty(*grid.shape))
    scattered, transmittance = march_rays(outgoing, bundle, every_ray(1))
    is_miss = chords(grid, bundle) == 0
    assert bool(is_miss.any()) or view is VIEWS["inside"]
    assert not scattered[:, is_miss].any() and bool((transmittance[:, is_miss] == 1).all())
    assert bool((scattered[:, ~is_miss] > 0).all()) and bool((transmittance[:, ~is_miss] < 1).all())


def test_a_ray_that_rounding_tilts_runs_beside_a_volume_that_repeats():
    """Else it would come in so far away that no engine knows where."""
    grid = replace(box_grid((3, 5, 4)), periodic=(0, 2))
    above, along = torch.tensor([[[0, 1, 0]], [[0.6, -4e-17, 0.8]]], dtype=torch.float64)
    assert not len(cross_box(grid, Rays(above, along, None)).hit)


def test_a_box_behind_the_camera_is_not_seen():
    grid, bundle = box_grid((3, 5, 4)), cast_rays(make_camera())
    away = Rays(bundle.origin, -bundle.direction, bundle.eye)
    outgoing = emission_of(grid, 0.1 + half_empty(*grid.shape))
    scattered, transmittance = march_rays(outgoing, away, every_ray(1))
    assert not scattered.any() and bool((transmittance == 1).all())


@pytest.mark.parametrize("view", [VIEWS["oblique"], VIEWS["inside"]], ids=["oblique", "inside"])
def test_chunks_do_not_matter(view, monkeypatch):
    """Neither to what is seen nor to its derivative."""
    density = (0.1 + half_empty(9, 11, 10)).requires_grad_()
    bundle = cast_rays(make_camera(size=(7, 6), **view))

    def marched():
        seen = march_rays(emission_of(box_grid((9, 11, 10)), density), bundle, every_ray(2))
        return [*seen, *torch.autograd.grad((seen[0] - seen[1]).square().sum(), density)]

    whole = marched()
    monkeypatch.setattr(march_module, "CHUNK_NODES", 40)
    monkeypatch.setattr(march_module, "CELLS_PER_NODE", 100)
    for one, other in zip(whole, marched(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-14)


def test_more_steps_and_samples_keep_a_homogeneous_transmittance():
    """Background light through an absorbing box: the average over a pixel of exp(-kappa chord)."""
    absorbing = {"sigma_s": (0.0,), "directional": None, "ambient": (1.0,)}
    scene = make_scene(torch.ones(3, 5, 4, dtype=torch.float64), **absorbing)
    image = render(replace(scene, render=RenderSettings(samples_per_pixel=4, steps_per_voxel=2)))[0]
    bundles = [cast_rays(scene.views[0].camera, offset) for offset in subpixel_offsets(4)]
    lengths = torch.stack([chords(scene.volume.grid, bundle) for bundle in bundles])
    for color, sigma in enumerate(scene.volume.sigma_a):
        expected = torch.exp(-sigma * lengths).mean(0)
        torch.testing.assert_close(image[color].flatten(), expected, rtol=1e-12, atol=0)


SHAPE = (5, 4, 6)
STEPS = (1, 6, 36)


BEAM, OTHER = (tensor(-2, -2, -1), tensor(3, 2, 1)), (tensor(1, 0.3, -0.5), tensor(1))
LIGHTS: dict[str, list[Light]] = {
    "two beams": [DirectionalLight(*BEAM), DirectionalLight(*OTHER)],
    "a point outside": [PointLight(tensor(0.9, 0.8, -0.7), tensor(2))],
    "a point inside": [PointLight(tensor(0.1, 0.2, -0.1), tensor(2, 1, 3))],
    "a beam and ambient light": [DirectionalLight(*BEAM), AmbientLight(tensor(0.5, 0.4, 0.3))],
    "a sky": [EnvironmentLight(random_values(3, 8, 16), tensor(20)[0], tensor(1)[0], 8)],
}


@pytest.fixture
def same_fields(monkeypatch):
    """Masses are interpolated linearly, and E8.7 is summed itself, in the fast march as well."""

    def along(seen, depth, cosine):
        if seen.number is not None:
            cells = seen.phase.with_cells(seen.number.movedim(1, 0)[..., None])
            seen = SeenPhase(cells, seen.degree)
        elif depth is None:
            return seen.phase.value(cosine)
        if depth is None:
            return seen.phase.value(cosine[..., None])[..., 0].movedim(0, 1)
        return summed_series(seen, depth.movedim(1, 0), cosine).movedim(0, 1)

    def at_angles(seen, depth, angle):
        actual = along(seen, depth, angle.cos())
        return actual.movedim(0, 1) if depth is None and seen.number is None else actual

    monkeypatch.setattr(ThirdOrder, "bounded", lambda _, correction: 0 * correction)
    monkeypatch.setattr(SeenPhase, "along", along)
    monkeypatch.setattr(SeenPhase, "at_angles", at_angles)


def lit_scene(lights, view, **changes):
    """A random medium; under a sky alone nothing scatters twice: it is lit by all directions."""
    model = "none" if isinstance(lights[0], EnvironmentLight) else "p1"
    cross_sections = {"sigma_a": (0.5, 1.0, 0.2), "sigma_s": (3.0, 2.0, 1.0)}
    settings = {"g": 0.6, "model": model, "directional": None} | cross_sections | changes
    scene = make_scene(random_values(*SHAPE), camera=make_camera(**view), **settings)
    return replace(scene, lights=lights)


def march_plainly(outgoing, rays, steps):
    """Radiance [C, R] along `rays` and transmittance [C, R] (E2.1), by so many equal steps each."""
    grid = outgoing.grid
    near, far = intersect_box(grid, rays)
    part = torch.linspace(0, 1, steps + 1, dtype=near.dtype, device=near.device)
    distance = near + part[:, None] * (far - near).clamp(min=0)
    points = rays.origin + distance[..., None] * rays.direction
    # What is between the camera and each node: the integral of the extinction's field, and tau.
    fields = extend_fields(outgoing, None)
    extinction = interpolate(grid, fields["extinction"], points)
    passed = pad(torch.cumulative_trapezoid(extinction, distance, dim=1), (0, 0, 1, 0))
    scale = outgoing.extinction.scale.view(-1, 1, 1)
    # E2.3: the radiance kappa_s (L0 + g L1 . w) that one more scattering turns towards the camera.
    field = fields.get("scattering", fields["extinction"])
    scattering = interpolate(grid, outgoing.scattering.scale * field, points)
    by = outgoing.remaining or outgoing.scattering
    remaining = interpolate(grid, by.scale * fields.get("remaining", field), points)
    emitted = remaining * interpolate(grid, fields["diffuse"], points)
    seen, number = outgoing.seen, outgoing.seen.phase.cells
    if number is not None:
        # The number of the phase function that differs from cell to cell, as one of each node.
        at_nodes = interpolate(grid, fields["number"], points)
        seen = replace(seen, phase=seen.phase.with_cells(at_nodes[..., None]))
    for index, beam in enumerate(outgoing.beams):
        # E2.2: kappa_s p E tau / (4 pi), where tau is what lies between the light and the node.
        travel, irradiance = unattenuated(beam, points, rays.direction)
        cosine = -(travel * rays.direction).sum(-1).expand(distance.shape)
        mass = interpolate(grid, fields[f"mass {index}"], points)
        if outgoing.peak is None:
            phase = seen.phase.value(cosine[..., None])[..., 0]
        else:
            # E8.7: the forward peak spreads the light on its way to the node and to the camera.
            peak = interpolate(grid, fields.get("peak", outgoing.peak), points)
            depth = peak * (passed + mass)
            phase = summed_series(seen, depth, cosine)
        arriving = irradiance / (4 * math.pi) * torch.exp(-scale * mass)
        emitted = emitted + scattering * phase * arriving
    # E2.2 + E2.3: the integral of tau times that, and tau of the whole way.
    tau = torch.exp(-scale * passed)
    scattered = torch.trapezoid(tau * emitted, distance, dim=1)
    return scattered, tau[:, -1].expand_as(scattered)


def interpolate(grid, field, points):
    """Of a `field` with a layer more on each side, or of one number."""
    low, extent = points.new_tensor(grid.lower), points.new_tensor(grid.extent)
    longer = points.new_tensor(field.shape[1:]) / points.new_tensor(grid.shape)
    places = ((2 * (points - low) / extent - 1) / longer).flip(-1)
    ways = {"padding_mode": "border", "align_corners": False}
    return grid_sample(field[None], places[None, None], **ways)[0, :, 0]


def unattenuated(beam, points, direction):
    if isinstance(beam, Beam):
        return beam.direction, beam.irradiance[..., 0]
    offset = points - beam.position
    along = (offset * direction).sum(-1)
    square = along**2 + (offset.square().sum(-1) - along**2).clamp(min=beam.least_square)
    return offset / square.sqrt()[..., None], beam.irradiance[..., 0] / square


def emit(scene):
    rays = cast_rays(scene.views[0].camera)
    return send(solve_light(scene, SolveMemory()), rays), rays


def march_fast(outgoing, rays, steps):
    return march_rays(outgoing, rays, RenderSettings(steps_per_voxel=steps, tolerance=0.0))


def march_twin(outgoing, rays, steps):
    return march_plainly(outgoing, rays, 12 * steps)


def differences(of):
    """How far apart the two marches' `of(marcher, steps)` are, relative to the norm, at STEPS."""
    apart = []
    for steps in STEPS:
        pairs = zip(of(march_fast, steps), of(march_twin, steps), strict=True)
        apart.append([float((fast - plain).norm() / plain.norm()) for fast, plain in pairs])
    return [list(errors) for errors in zip(*apart, strict=True)]


CROSS_SECTION = random_values(3, *SHAPE, seed=7)
MEDIA: dict[str, dict[str, Any]] = {
    "isotropic": {"g": 0.0},
    "backward": {"g": -0.4},
    "scattering varies": {"sigma_s": CROSS_SECTION},
    "absorption varies": {"sigma_a": CROSS_SECTION, "g": 0.0},
}
PHASES: dict[str, PhaseFunction] = {
    "g varies": HenyeyGreenstein(1.2 * random_values(*SHAPE, seed=8) - 0.4),
    "weight varies": TwoLobe(tensor(0.6, -0.3), random_values(*SHAPE, seed=9)),
}
CASES = [(light, "inside" if "point" in light else "oblique", "") for light in LIGHTS]
CASES += [("two beams", view, "") for view in ("perspective", "orthographic", "inside")]
CASES += [("two beams", "oblique", medium) for medium in [*MEDIA, *PHASES]]
CASES += [("a point inside", "oblique", phase) for phase in PHASES]


@pytest.mark.parametrize(("lights", "view", "medium"), CASES)
@pytest.mark.usefixtures("same_fields")
def test_images_agree_in_the_limit(lights, view, medium):
    scene = lit_scene(LIGHTS[lights], VIEWS[view], **MEDIA.get(medium, {}))
    scene.volume.phase = PHASES.get(medium, scene.volume.phase)
    outgoing, rays = emit(scene)
    for errors in differences(lambda marcher, steps: list(marcher(outgoing, rays, steps))):
        assert errors[-1] < 1e-3, errors
        assert convergence_order([1 / steps for steps in STEPS], errors) > 1.6, errors


def test_they_agree_with_finer_cells_whatever_is_interpolated():
    """Masses to third order or linearly, E8.7 by a table or itself: in a smooth medium."""
    errors = []
    for count in (8, 16, 32):
        scene = lit_scene(LIGHTS["two beams"][:1], VIEWS["oblique"], g=0.3, model="none")
        axes = [torch.linspace(-1, 1, count + 1)[1:] - 1 / count for _ in range(3)]
        z, y, x = torch.meshgrid(*axes, indexing="ij")
        density = 2 * torch.exp(-2 * (x**2 + y**2 + z**2)).double()
        grid = replace(scene.volume.grid, shape=density.shape)
        volume = replace(scene.volume, density=density, grid=grid)
        outgoing, rays = emit(replace(scene, volume=volume))
        fast, plain = march_fast(outgoing, rays, 4)[0], march_twin(outgoing, rays, 16)[0]
        errors.append(float((fast - plain).norm() / plain.norm()))
    assert errors[-1] < 2e-3 and convergence_order([1 / 8, 1 / 16, 1 / 32], errors) > 1.5, errors


def test_rounding_does_not_choose_between_axes():
    """Seen at 45 degrees two axes are crossed equally fast: slices lie across the first of them."""
    grid = Grid((6, 6, 6), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    rays = cast_rays(make_camera(eye=(2.5, 0.0, 2.5), half_width=0.2))
    for _ in range(8):
        noise = 1 + 1e-15 * torch.randn(3, dtype=torch.float64)
        bundle = replace(rays, direction=rays.direction * noise)
        assert choose_sampling(grid, bundle, cross_box(grid, bundle)).axis == 0
