"""Fields up to the faces of the box; what a support leaves out is not walked (E10.4)."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from media import box_grid, half_empty, make_camera, make_scene, march_rays, random_values
from scenes import VIEWS
from twins import assert_same, assert_transposes, differentiate, images_of, values_of

from ddrecon.cameras import Rays, cast_rays
from ddrecon.engine import use_engine
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.faces import cells_at_faces, extend_fields, receive_at_faces, shine_through
from ddrecon.march.outgoing import Inflow, OutgoingLight
from ddrecon.march.samplers import (
    RaySampling,
    Sampler,
    intersect_box,
    planes_across,
    support_of_planes,
)
from ddrecon.march.sight import look_through
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.picture import render
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import with_values

GRID = box_grid((3, 5, 4))
TRAVEL = torch.tensor([-0.6, 0.8, 0.0], dtype=torch.float64)
POSITION = torch.tensor([0.0, 0.1, 4.0], dtype=torch.float64)


def emission_of(diffuse, *masses):
    """A thin medium with some diffuse light, one directional and one point light."""
    one = torch.ones(1, dtype=torch.float64)
    density = torch.ones(GRID.shape, dtype=torch.float64)
    medium = scale_medium(Volume(GRID, density, 1e-13 * one, 1e-12 * one, 0 * one[0]))
    lights = [
        (Beam, TRAVEL, one.view(1, 1, 1, 1)),
        (PointBeam, POSITION, one.view(1, 1, 1, 1), 0.1),
    ]
    beams = tuple(kind(mass, *rest) for mass, (kind, *rest) in zip(masses, lights, strict=False))
    matter = medium.extinction, medium.scattering
    return OutgoingLight(GRID, *matter, beams, diffuse, medium.seen, medium.peak)


def linear(*point):
    return 2 + 0.5 * point[0] - 0.7 * point[1] + 0.3 * point[2]


@pytest.mark.parametrize("engine", ["torch", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("view", [{"half_width": 0.1}, VIEWS["inside"]], ids=["far", "inside"])
def test_linear_light_in_a_thin_medium_is_summed_exactly(engine, steps, view):
    """kappa_s times the length in the box times the light in its middle."""
    use_engine(engine)
    rays = cast_rays(make_camera(size=(5, 6), **view))
    diffuse = linear(*GRID.centers(TRAVEL))[None]
    settings = RenderSettings(steps_per_voxel=steps, tolerance=0.0)
    scattered = march_rays(emission_of(diffuse), rays, settings)[0][0]
    near, far = intersect_box(GRID, rays)
    middle = rays.origin + 0.5 * (near + far)[:, None] * rays.direction
    expected = 1e-12 * (far - near) * linear(*middle.unbind(1))
    torch.testing.assert_close(scattered, expected, rtol=1e-10, atol=0)


@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_masses_are_zero_where_light_enters_and_others_go_on(axis):
    """Constant light stays constant, and so does matter; linear masses are linear where unlit."""
    mass = linear(*GRID.centers(TRAVEL))[None]
    fields = extend_fields(emission_of(torch.full_like(mass, 3.0), mass, mass), axis)
    for name, value in (("extinction", 1.0), ("diffuse", 3.0)):
        torch.testing.assert_close(fields[name], torch.full_like(fields[name], value))
    for name, lit in (("mass 0", [(0, 1), (1, 0)]), ("mass 1", [(2, 1)])):
        for face in product(range(3), range(2)):
            layer, last, before = (
                fields[name].select(1 + face[0], -1 - k if face[1] else k)[:, 1:-1, 1:-1]
                for k in range(3)
            )
            on_face = layer if axis == face[0] else 0.5 * (layer + last)
            expected = 0 * last if face in lit else 1.5 * last - 0.5 * before
            torch.testing.assert_close(on_face, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("sampling", [RaySampling(None, longest=1.0), RaySampling(0)], ids=str)
def test_up_to_faces_masses_are_linear(sampling):
    """From the outermost centers on, where inside they are of third order."""
    outgoing = emission_of(*random_values(2, 1, *GRID.shape, seed=1))
    sampler, (z, y, x) = Sampler(outgoing, sampling, 3), GRID.centers(TRAVEL)
    origin = torch.stack([TRAVEL.new_tensor(GRID.lower[0]), y[0, 2, 0], x[0, 0, 1]])[None]
    rays, far = Rays(origin, TRAVEL.new_tensor([[1.0, 0, 0]]), None), z[0] - GRID.lower[0]
    if sampling.axis is not None:
        far = far.new_full((1, 1), GRID.extent[0])
    values, distance = sampler.sample(sampler.values, rays, 0 * far[0], far[0])
    mass, inside = values[:, 2, 0], distance[:, 0] <= float(z[0] - GRID.lower[0]) * (1 + 1e-9)
    slopes = (mass.diff() / distance[:, 0].diff())[inside[1:]]
    assert len(slopes) >= 3 and float(slopes.diff().abs().max()) < 1e-9 < float(slopes.abs().min())


def test_light_through_a_face_begins_smoothly():
    """A direction, or a place, a little to the one side and to the other."""
    for way in (-1e-6, 0.0, 1e-6):
        along = torch.tensor([way, 1.0, 0.0])
        beyond = torch.tensor([-way + GRID.lower[0], 0.0, 0.0])
        for place, is_point in ((along, False), (beyond, True)):
            assert float(shine_through(GRID, place, is_point)[0]) <= 1e-8


def test_light_lacks_as_much_on_faces_however_far_fields_are_extended():
    """Half a cell beyond faces, or up to them (E2.17); amid each face."""
    outgoing, depth = emission_of(random_values(1, *GRID.shape)), torch.full((1, 1, 1, 1), 4.0)
    matter = replace(outgoing.extinction, scale=depth.double())
    backward = random_values(1, cells_at_faces(GRID, outgoing.diffuse).shape[-1], seed=5)
    outgoing = replace(outgoing, extinction=matter, scattering=matter)
    coming = replace(outgoing, inflow=Inflow(0.2 * depth, 0 * backward, 0.9 * depth, backward))
    changes = [
        torch.sub(*(extend_fields(light, axis)["diffuse"] for light in (coming, outgoing)))
        for axis in (None, 0, 1, 2)
    ]
    for axis, side in product(range(3), range(2)):
        layers, last = (
            [change.select(1 + axis, -1 - k if side else k)[:, 2:-2, 2:-2] for change in changes]
            for k in range(2)
        )
        on_face = layers[1 + axis]
        assert bool(on_face.all())
        torch.testing.assert_close(0.5 * (layers[0] + last[0]), on_face, rtol=1e-12, atol=0)


@pytest.mark.parametrize("engine", ["torch", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_extended_fields_have_both_derivatives(axis, engine):
    """By light, by masses, and by where it comes from; some of what goes on would be negative.

    And by what thick cells receive, of which less comes in than goes out.
    """
    use_engine(engine)
    diffuse, *masses, got = (random_values(1, *GRID.shape, seed=k).pow(4) for k in range(4))
    backward = random_values(1, cells_at_faces(GRID, got).shape[-1], seed=5)
    direction, position = TRAVEL + 0.05, torch.tensor([-0.6, 0.1, 0.2], dtype=torch.float64)

    def extend(diffuse, *rest):
        masses, places, depth = rest[:2], rest[2:], rest[4].view(1, 1, 1, 1)
        outgoing = emission_of(diffuse, *masses)
        received = receive_at_faces(GRID, rest[5].expand(4, -1, -1, -1, -1))
        coming = Inflow(0.2 * depth, received, 0.9 * depth, backward)
        matter = replace(outgoing.extinction, scale=depth)
        outgoing = replace(outgoing, extinction=matter, scattering=matter, inflow=coming)
        beam, point = outgoing.beams
        beams = replace(beam, direction=places[0]), replace(point, position=places[1])
        fields = extend_fields(replace(outgoing, beams=beams), axis)
        return fields["diffuse"], fields["mass 0"], fields["mass 1"]

    depth = TRAVEL.new_tensor(4.0)
    given = [one.requires_grad_() for one in (diffuse, *masses, direction, position, depth, got)]
    assert torch.autograd.gradcheck(extend, given, check_forward_ad=True, fast_mode=True)


SHAPE = (7, 9, 8)
PACKETS, RAYS = ["density", "g"], ["density", "views.view.camera"]
TWO_STEPS, LATTICE = {"steps_per_voxel": 2}, {"tolerance": 0.05}


def two_blobs():
    """A support that rays enter twice, or once, or not at all."""
    support = torch.zeros(SHAPE, dtype=torch.float64)
    support[0:2, 2:5, 2:6] = 1
    support[5:6, 3:6, 1:4] = 1
    return support


def scene_with(support, settings, is_gray=False, **view):
    """A scene of which density lies in `two_blobs`, whether it is told so or not."""
    camera = make_camera(**({"size": (9, 10), "half_width": 0.4} | view))
    density = half_empty(*SHAPE) * two_blobs()
    medium = {"sigma_a": (1.0,), "sigma_s": (6.0,)} if is_gray else {"g": 0.5}
    scene = make_scene(density, ambient=(0.3,), camera=camera, **medium)
    scene.volume = replace(scene.volume, support=support)
    scene.render = replace(RenderSettings(**settings), background=True)
    return scene


ENGINES = ["torch", pytest.param("warp", marks=pytest.mark.slow)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("settings", [{}, TWO_STEPS, LATTICE], ids=str)
@pytest.mark.parametrize("names", [PACKETS, RAYS], ids=["packets", "rays"])
def test_images_and_derivatives_are_those_without_it(engine, settings, names):
    """But for those by the density outside, which are 0, and changes of which nobody sees."""
    support, size = two_blobs(), (30, 31) if settings == LATTICE else (9, 10)
    without, within = (
        scene_with(given, settings, names is RAYS, size=size) for given in (None, support)
    )
    values = values_of(within, names)
    derivatives = differentiate(engine, images_of(within), values, has_tangent=True)
    assert_transposes(derivatives, values)

    def show(values):
        """Without a support, of which the density outside varies as little as with it."""
        density = values["density"] * support + (values["density"] * (1 - support)).detach()
        return images_of(without)(values | {"density": density})

    assert_same(derivatives, differentiate(engine, show, values, has_tangent=True), 1e-11)
    outside = differentiate(engine, images_of(without), values)["by density"] * (1 - support)
    assert bool(outside.any())


def test_rays_that_miss_it_show_what_is_behind():
    """Exactly, and what they show does not change with any cell."""
    scene = scene_with(two_blobs(), {}, half_width=0.9)
    image = render(scene)
    is_behind = (image == 0.3).all(1)
    assert bool(is_behind.any()) and not bool(is_behind.all())
    changed = with_values(scene, {"density": scene.volume.density + 1})
    assert torch.equal((render(changed) == 0.3).all(1), is_behind)


@pytest.mark.slow
def test_what_it_leaves_out_is_not_walked():
    """By bits: none of no support, and of blobs less than half of what all cells have."""
    pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
    from ddrecon.march.fused.cells import find_walked
    from ddrecon.march.fused.integrate import pack_rays

    scene = scene_with(two_blobs(), {}, half_width=0.6)
    grid = scene.volume.grid
    sight = look_through(scene.views[0].camera, grid, scene.render)
    planes = planes_across(grid, sight.sampling, 1, torch.float64, torch.device("cpu"))
    rays, ends = sight.rays, vars(sight.crossing).values()
    bundle = pack_rays(grid, sight.sampling.axis, rays.origin, rays.direction, *ends).bundle

    def count(support):
        bits = find_walked(support_of_planes(support, sight.sampling, 1), planes, bundle)
        return sum(number.bit_count() for number in bits.flatten().tolist())

    none, some, all_of_them = map(count, (torch.zeros(SHAPE), two_blobs(), torch.ones(SHAPE)))
    assert none == 0 < some < all_of_them / 2
