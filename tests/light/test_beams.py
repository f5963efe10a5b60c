"""Beams: the mass that they pass, and what cells receive of them and of a sky."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from media import (
    box_grid,
    convergence_order,
    half_empty,
    make_camera,
    make_scene,
    random_values,
    tensor,
)

from ddrecon.diffusion.cells import average_cells
from ddrecon.grid import Grid
from ddrecon.light.lights import BeamLight, DirectionalLight
from ddrecon.light.moments import beam_moments, flux_along_axes, weigh
from ddrecon.light.pairs import follow_pair
from ddrecon.light.profile import profile_in
from ddrecon.light.reduced import ambient_sky, receive_light, sum_unscattered_sky
from ddrecon.light.shear import sum_masses
from ddrecon.lighting import fluence
from ddrecon.medium.coefficients import (
    Volume,
    backward_fraction,
    refine_medium,
    remaining_moments,
    scale_medium,
    unturned_moments,
)
from ddrecon.numerics.sphere import sphere_quadrature
from ddrecon.picture import render
from ddrecon.settings import RenderSettings

SLANTED = [(0.8, 0.3, -0.5), (-0.2, 0.9, 0.4), (0.3, -0.1, -0.7)]


def unit(direction):
    vector = torch.tensor(direction, dtype=torch.float64)
    return vector / vector.norm()


def sum_mass_to_cells(field, grid, direction):
    (entered,), (step,) = sum_masses(field, grid, direction[None], 0.0)
    return entered, step


@pytest.mark.parametrize(
    "direction", [d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)], ids=str
)
def test_where_rays_run_through_centers_the_mass_is_that_of_the_cells_behind(direction):
    """Along axes and diagonals of cubic cells: that there, and midway the mean of all around."""
    upper = (1.25, 1.3, 0.9) if direction.count(0) == 2 else (1.25, 1.0, 1.5)
    grid, field = Grid((5, 4, 6), (0, 0, 0), upper), random_values(5, 4, 6)
    entered, step = sum_mass_to_cells(field[None], grid, unit(direction))
    behind = torch.zeros_like(field)
    for cell in itertools.product(*map(range, grid.shape)):
        here = cell
        while True:
            there = tuple(i - int(d) for i, d in zip(here, direction, strict=True))
            if not all(0 <= i < n for i, n in zip(there, grid.shape, strict=True)):
                break
            corners = [*itertools.product(*({i, j} for i, j in zip(here, there, strict=True)))]
            midway = sum(field[corner] for corner in corners) / len(corners)
            behind[cell] += field[there] + (midway - (field[here] + field[there]) / 2) / 2
            here = there
    torch.testing.assert_close(entered[0], step * behind, rtol=0, atol=1e-14)
    paths = [h / abs(d) for h, d in zip(grid.spacing, unit(direction).tolist(), strict=True) if d]
    assert step.item() == pytest.approx(min(paths), rel=1e-15)


@pytest.mark.parametrize("direction", SLANTED, ids=str)
def test_in_a_linear_field_the_mass_is_that_of_each_ray(direction):
    """Where no ray comes within two cells of the sides: interpolation of both is exact there."""
    slope = tensor(0.4, -0.3, 0.7)
    grid, travel = Grid((11, 12, 11), (0, 0, 0), (1.0, 1.2, 0.9)), unit(direction)
    last = travel.new_tensor(grid.shape) - 1
    index = torch.stack(torch.meshgrid(*map(torch.arange, grid.shape), indexing="ij"), -1).double()
    # A step leads from slice to slice across the fastest axis, over so many cells along each.
    speed = travel / travel.new_tensor(grid.spacing)
    axis = int(speed.abs().argmax())
    step, moved = 1 / speed[axis].abs(), speed / speed[axis].abs()
    count = (index if travel[axis] > 0 else last - index)[..., axis, None]
    entered, _ = sum_mass_to_cells((20 + index @ slope)[None], grid, travel)
    mean = 20 + (index - (count + 1) / 2 * moved) @ slope
    wanted, first = step * count[..., 0] * mean, index - count * moved
    sides = [other for other in range(3) if other != axis]
    ends = torch.stack([index, first, last - index, last - first])[..., sides]
    is_within = ends.amin((0, -1)) >= 2
    assert int(is_within.sum()) > 100
    torch.testing.assert_close(entered[0][is_within], wanted[is_within], rtol=1e-13, atol=0)


@pytest.mark.parametrize("direction", [*SLANTED, (0.9, 0.2, 0.02), (1.0, 1.0, 1.0)], ids=str)
def test_in_an_even_block_the_mass_is_the_way_from_the_face(direction):
    """Up to the faces: where the light of two cells around comes by the same one, it is exact."""
    grid, travel = Grid((14, 12, 13), (0, 0, 0), (1.4, 1.1, 1.3)), unit(direction)
    places = torch.broadcast_tensors(*grid.centers(travel))
    ways = torch.stack(
        [
            (place - (low if part > 0 else high)) / part
            for place, low, high, part in zip(places, grid.lower, grid.upper, travel, strict=True)
        ]
    )
    way, face = ways.min(0)
    shifts = itertools.product(range(-2, 3), repeat=3)
    same = torch.stack([face.roll(shift, (0, 1, 2)) == face for shift in shifts]).all(0)
    # Rays that enter more than a slice later count as if they entered then.
    for through, size, part in zip(ways, grid.spacing, travel, strict=True):
        same &= through > 2 * size / part.abs()
    field = torch.full((1, *grid.shape), 3.0, dtype=torch.float64)
    entered, step = sum_mass_to_cells(field, grid, travel)
    mass = (entered + 0.5 * step * field)[0]
    assert int(same.sum()) > 100
    torch.testing.assert_close(mass[same], 3 * way[same], rtol=1e-13, atol=0)


def test_what_comes_through_a_side_is_received():
    """Under a sun at 60 degrees, by columns of a layer that cells cross sideways: order 2."""
    errors, depths = [], [1.0, 0.5, 0.25]
    for depth in depths:
        layers, columns = round(4 / depth), round(12 / depth)
        grid = Grid((layers, 1, columns), (0, 0, 0), (4.0, 1e6, 12.0))
        field = torch.ones(1, *grid.shape, dtype=torch.float64)
        entered, step = sum_mass_to_cells(field, grid, unit((0.5, 0.0, 0.75**0.5)))
        received = torch.exp(-entered) * (1 - torch.exp(-step)) / step
        taken = 2 * depth * received[0, :, 0, -columns // 4 :].mean(1).sum()
        errors.append(abs(float(taken) / (1 - math.exp(-8)) - 1))
    assert errors[1] < 0.02, errors
    assert convergence_order(depths, errors) >= 1.8, errors


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.4142, -0.5, 0.6)], ids=str)
def test_entered_mass_has_both_derivatives(direction):
    """By the field, and by a direction on whose sides it is the same formula."""
    grid, field = box_grid((3, 2, 3)), 0.5 + half_empty(1, 3, 2, 3)
    heading = unit(direction).requires_grad_(0.0 not in direction)
    assert torch.autograd.gradcheck(
        lambda *given: sum_masses(given[0], grid, given[1][None], 1.7)[0],
        (field.requires_grad_(), heading),
        check_forward_ad=True,
    )


AXES = (0.0, 0.0, -1.0), (0.3, -1.0, 0.2), (0.5, 0.4, 1.3)


def length_in_box(direction):
    """Of the line along `direction` (x, y, z) through the middle of a box 0.9 x 1.2 x 1."""
    half = tensor(0.45, 0.6, 0.5)
    return 2 * float((half / (direction / direction.norm()).abs()).min())


@pytest.mark.parametrize("radius", [0.0, 0.03, 0.1])
@pytest.mark.parametrize("axis", AXES)
def test_cells_together_receive_the_power_of_a_beam(axis, radius):
    """In an empty box, power times way; along z wherever in its cell the axis runs."""
    grid, direction = box_grid((16, 20, 18)), tensor(*axis)
    for shift in (0.0, 0.013, 0.03) if axis == AXES[0] else (0.0,):
        place = tensor(0.05 + shift, -0.7 * shift, 3.0 * shift) - 3 * direction
        profile = profile_in(grid, place, direction, tensor(radius)[0])
        way = float(profile.sum()) * math.prod(grid.spacing)
        assert way == pytest.approx(length_in_box(direction), rel=1e-5)


@pytest.mark.parametrize("axis", AXES)
def test_a_profile_is_the_mean_of_the_gaussian_over_each_cell(axis):
    grid, direction, radius = box_grid((4, 5, 6)), tensor(*axis), 0.4
    place = tensor(0.1, -0.05, 0.02)
    irradiance = profile_in(grid, place, direction, tensor(radius)[0])[0]
    fine = box_grid((40, 50, 60))
    z, y, x = torch.broadcast_tensors(*fine.centers(irradiance))
    offset = torch.stack([x, y, z], -1) - place
    travel = direction / direction.norm()
    square = offset.square().sum(-1) - (offset @ travel) ** 2
    exact = 2 / (math.pi * radius**2) * torch.exp(-2 * square / radius**2)
    mean = torch.nn.functional.avg_pool3d(exact[None, None], 10)[0, 0]
    torch.testing.assert_close(irradiance, mean, rtol=0, atol=1e-2 * float(mean.max()))


@pytest.mark.parametrize(
    "changes", [{}, {"g": 0.8, "transport_rounds": 1}, {"model": "none"}], ids=str
)
def test_a_very_wide_beam_is_a_directional_light(changes):
    direction, radius, irradiance = tensor(-0.4, -1.0, 0.3), 1e4, tensor(3.0, 2.0, 1.0)
    power = irradiance * math.pi * radius**2 / 2
    beam = BeamLight(tensor(0.0, 2.0, 0.0), direction, power, tensor(radius)[0])
    scene = make_scene(random_values(4, 5, 6), **changes)
    wide, sun = (
        replace(scene, lights=[light]) for light in (beam, DirectionalLight(direction, irradiance))
    )
    torch.testing.assert_close(fluence(wide), fluence(sun), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(render(wide), render(sun), rtol=1e-6, atol=1e-9)


def test_view_rays_see_what_a_thin_beam_scatters():
    """In thin air, from the side: power times cross section in all; three pixels to a cell."""
    density = torch.full((16, 18, 20), 1e-4, dtype=torch.float64)
    beam = BeamLight(tensor(0.02, 2.0, 0.07), tensor(0.0, -1.0, 0.0), tensor(2.0), tensor(0.0)[0])
    camera = make_camera((0.0, 0.0, 3.0), (120, 120), 0.9, is_perspective=False)
    scene = make_scene(density, sigma_a=(0.0,), sigma_s=(5.0,), model="none", camera=camera)
    image = render(replace(scene, lights=[beam], render=RenderSettings(tolerance=0)))[0, 0]
    pixel = (2 * 0.9 / 120) ** 2
    expected = 2.0 * 5e-4 * 1.2 / (4 * math.pi)
    assert float(image.sum()) * pixel == pytest.approx(expected, rel=2e-3)


IRRADIANCE = 3.0


def in_unit_box(density, travel=(0.0, 0.0, 2.0), **changes):
    grid = Grid(tuple(density.shape), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    medium = {"sigma_a": (0.5,), "sigma_s": (6.0,), "directional": (IRRADIANCE,)}
    return make_scene(density, grid=grid, travel=travel, **medium, **changes)


def test_energy_is_kept_where_the_backward_peak_differs_from_cell_to_cell():
    """What F and G lose in a cell is what scatters there and is absorbed, and the rest leaves."""
    torch.manual_seed(1)
    density, g = torch.rand(2, 9, 1, 1, dtype=torch.float64)
    density[4] = 0
    scene = in_unit_box(density)
    scene.volume.g = 0.6 - 1.5 * g
    medium = scale_medium(scene.volume, 3)
    pair = follow_pair(medium, scene.lights[0])
    # what a cell takes, kappa_t of both less what it turns, and what it hands on to its neighbors
    turned = backward_fraction(medium) * medium.scattering.value
    beams = 4 * math.pi / 9 * (pair.along + pair.against)
    taken = ((medium.extinction.value - turned) * beams).flatten()
    # a slab of layers, each by its own closed form, added up from the far end
    passed, reflected = 1.0, 0.0
    beta = (turned / medium.extinction.value).nan_to_num().flatten()
    depth = medium.extinction.value.flatten() / 9
    for k in reversed(range(9)):
        rate = math.sqrt(1 - float(beta[k]) ** 2)
        back, through = float(beta[k]) / (1 + rate), math.exp(-rate * float(depth[k]))
        norm = 1 / (1 - (back * through) ** 2)
        lets, turns = (1 - back**2) * through * norm, back * (1 - through**2) * norm
        again = 1 / (1 - turns * reflected)
        passed, reflected = lets * again * passed, turns + lets**2 * reflected * again
    assert float(taken.sum()) == pytest.approx(IRRADIANCE * (1 - passed - reflected), rel=1e-12)


def test_a_slanted_pair_in_an_even_box_takes_what_it_takes_of_each_ray():
    """By the closed form of E8.11 for the depth of each, whichever face it enters by."""
    travel, taken = tensor(1.0, -0.6, 2.0), []
    for cells in (6, 12, 24):
        scene = in_unit_box(torch.ones(3 * [cells]).double(), travel.tolist(), g=-0.7)
        medium = scale_medium(scene.volume, 3)
        pair = follow_pair(medium, scene.lights[0])
        beta = float(backward_fraction(medium)) * 6.0 / 6.5
        taken.append(4 * math.pi * 6.5 * (1 - beta) * float((pair.along + pair.against).mean()))
    rate, wanted, way = math.sqrt(1 - beta**2), 0.0, (travel / travel.norm()).abs()
    place = (torch.arange(200).double() + 0.5) / 200
    for axis in range(3):
        across = [place.view(-1, 1) / way[axis - 2], place / way[axis - 1], 1 / way[axis]]
        depth = 6.5 * torch.stack(torch.broadcast_tensors(*across)).amin(0)
        turned, passed = beta / (1 + rate), torch.exp(-rate * depth)
        leaves = (1 - turned**2) * passed + turned * (1 - passed**2)
        leaves = leaves / (1 - (turned * passed) ** 2)
        wanted += IRRADIANCE * float(way[axis] * (1 - leaves).mean())
    off = [abs(power / wanted - 1) for power in taken]
    assert off[2] < 0.002 and off[2] < off[1] / 3 < off[0] / 9, off


@pytest.mark.parametrize("varied", ["g", "sigma_s"])
def test_an_empty_cell_is_the_limit_of_thin_ones(varied):
    """So are derivatives there: what cells that are not there yet would turn back is known."""
    torch.manual_seed(2)
    density, share = torch.rand(2, 5, 4, 3, dtype=torch.float64)
    density[1:3] = 0
    scene = in_unit_box(density, g=-0.7, travel=(0.5, -0.3, 2.0))
    volume = scene.volume
    if varied == "g":
        volume.g = -0.9 * share
    else:
        volume.sigma_s = 6 * share[None]

    def pair_at(least):
        volume.density = density.clamp(min=least).requires_grad_()
        pair = follow_pair(scale_medium(volume, 3), scene.lights[0])
        both = torch.stack([pair.along, pair.against])
        weights = torch.arange(1.0, both.numel() + 1, dtype=torch.float64).view_as(both).cos()
        return both.detach(), torch.autograd.grad((weights * both).sum(), volume.density)[0]

    for empty, thin in zip(pair_at(0.0), pair_at(1e-9), strict=True):
        torch.testing.assert_close(empty, thin, rtol=1e-7, atol=1e-7)


def test_what_a_beam_scatters_is_what_turns_back_and_the_rest():
    """In every moment: the backward peak is light that goes against the beam (E8.11)."""
    medium = scale_medium(in_unit_box(torch.ones(2, 1, 1).double(), g=-0.7).volume, 5)
    way, mean = torch.tensor([0.48, -0.6, 0.64]).double(), torch.ones(1, 2, 1, 1).double()
    back = backward_fraction(medium) / (1 - medium.forward_fraction)
    against = back * beam_moments(mean, -way, 5)
    rest, whole = (
        weigh(beam_moments(mean, way, 5), moments(medium))
        for moments in (unturned_moments, remaining_moments)
    )
    torch.testing.assert_close(rest + against, whole, rtol=1e-12, atol=1e-12)


def medium_in(grid, density, g=0.4, sigma=((0.5, 1.0), (3.0, 2.0))):
    sigma_a, sigma_s = (density.new_tensor(s) for s in sigma)
    return scale_medium(Volume(grid, density, sigma_a, sigma_s, density.new_tensor(g)))


def received(grid, density, lights, **medium):
    return receive_light(medium_in(grid, density, **medium), lights, degree=1).source


@pytest.mark.parametrize("g", [0.4, -0.4])
def test_in_even_columns_parts_of_cells_receive_what_cells_do(g):
    """Of a backward peak they receive pairs of beams."""
    grid, density = box_grid((4, 3, 2)), torch.full((4, 3, 2), 5.0, dtype=torch.float64)
    medium = scale_medium(Volume(grid, density, tensor(0.5, 1), tensor(3, 2), tensor(g)[0]), 3)
    lights = [DirectionalLight(tensor(0, 0, -2), tensor(2, 1))]
    lights += [DirectionalLight(tensor(0, 3, 0), tensor(1, 1))]
    narrow = average_cells(refine_medium(medium, 3))
    whole, in_parts = (receive_light(medium, lights, 1, cells).source for cells in (None, narrow))
    torch.testing.assert_close(in_parts, whole, rtol=1e-12, atol=0)


@pytest.mark.parametrize("zenith", [10.0, 60.0, 75.0])
def test_a_thick_uneven_layer_receives_all_light_of_a_slanted_sun(zenith):
    """Cells are 5 times as wide as high, and up to 18 optical depths wide; nothing gets through."""
    grid = Grid((24, 6, 8), (0, 0, 0), (0.48, 0.6, 0.8), periodic=(1, 2))
    z, y, x = (center / 0.2 for center in grid.centers(tensor(0)))
    density = (1 + 0.8 * (math.pi / 2 * x).sin() * (2 * math.pi / 3 * y).cos()) * (z < 1.9)
    medium = medium_in(grid, density, g=0.0, sigma=([5.0], [95.0]))
    angle = math.radians(zenith)
    light = DirectionalLight(tensor(math.sin(angle), 0, -math.cos(angle)), tensor(1))
    cells, narrow = average_cells(medium), average_cells(refine_medium(medium, 3))
    taken = [
        float((cells.extinction.value * receive_light(cells, [light], 0, parts).source).mean())
        * (4 * math.pi * grid.extent[0] / math.cos(angle))
        for parts in (None, narrow)
    ]
    off = [abs(share - 1) for share in taken]
    assert off[1] < 0.002 and off[1] < off[0] / 2, taken


def test_the_flux_of_a_beam_is_its_mean_times_its_direction():
    light = DirectionalLight(tensor(1, -2, 0.5), tensor(2, 1))
    source = received(box_grid((3, 4, 2)), random_values(3, 4, 2), [light], g=-0.4)
    way = torch.nn.functional.normalize(tensor(0.5, -2, 1), dim=0)
    expected = 3 * -0.4 * source[0] * way.view(3, 1, 1, 1, 1)
    torch.testing.assert_close(
        torch.stack(flux_along_axes(source[1:])), expected, rtol=1e-14, atol=0
    )


def test_in_a_wide_slab_ambient_light_is_the_sum_over_directions():
    """Each attenuated by kappa z / |cosine|, averaged over the cell; the sides are too far away."""
    cells, thickness = 6, 0.8
    grid = Grid((cells, 9, 9), (0, -1e3, -1e3), (thickness, 1e3, 1e3))
    density = torch.ones(grid.shape, dtype=torch.float64)
    medium = medium_in(grid, density, g=0.0, sigma=([0.3], [1.7]))
    sky = ambient_sky(torch.ones(1, 1, 1, 1, dtype=torch.float64))
    light = sum_unscattered_sky(medium, [sky], degree=1)
    directions, weights = sphere_quadrature(light)
    along_z, _, _ = flux_along_axes(light[1:])
    for cell in range(cells):
        mean = flux = 0.0
        for cosine, weight in zip(directions[:, 0].tolist(), weights.tolist(), strict=True):
            if abs(cosine) < 1e-9:
                continue
            step = 2.0 * thickness / cells / abs(cosine)
            crossed = (cell if cosine > 0 else cells - 1 - cell) * step
            average = (math.exp(-crossed) - math.exp(-crossed - step)) / step
            mean, flux = mean + weight * average, flux + 3 * weight * cosine * average
        assert light[0, 0, cell, 4, 4].item() == pytest.approx(mean, rel=1e-12)
        assert along_z[0, cell, 4, 4].item() == pytest.approx(flux, rel=1e-10, abs=1e-14)
