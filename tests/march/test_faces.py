"""Fields up to the faces of the box: light that is linear is so up to there."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from media import box_grid, make_camera, march_rays, random_values
from torch import Tensor

from ddrecon.cameras import cast_rays
from ddrecon.engine import use_engine
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.box import intersect_box
from ddrecon.march.faces import cells_at_faces, extend_fields, receive_at_faces, shine_through
from ddrecon.march.outgoing import Inflow, OutgoingLight
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.settings import RenderSettings

GRID = box_grid((3, 5, 4))
TRAVEL = torch.tensor([-0.6, 0.8, 0.0], dtype=torch.float64)
POSITION = torch.tensor([0.0, 0.1, 4.0], dtype=torch.float64)


def emission_of(diffuse: Tensor, *masses: Tensor) -> OutgoingLight:
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


def linear(*point: Tensor) -> Tensor:
    return 2 + 0.5 * point[0] - 0.7 * point[1] + 0.3 * point[2]


CAMERAS = {
    "straight": {"half_width": 0.1},
    "oblique": {"eye": (0.2, 0.3, 2.5), "half_width": 0.05},
    "inside": {"eye": (0.1, 0.2, 0.15), "half_width": 1.0},
}


@pytest.mark.parametrize("engine", ["torch", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS.keys())
def test_linear_light_in_a_thin_medium_is_summed_exactly(engine: str, steps: int, view: dict):
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
def test_masses_are_zero_where_light_enters_and_others_go_on(axis: int | None):
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


def test_light_through_a_face_begins_smoothly():
    """A direction, or a place, a little to the one side and to the other."""
    for way in (-1e-6, 0.0, 1e-6):
        along = torch.tensor([way, 1.0, 0.0])
        beyond = torch.tensor([-way + GRID.lower[0], 0.0, 0.0])
        for place, is_point in ((along, False), (beyond, True)):
            assert float(shine_through(GRID, place, is_point)[0]) <= 1e-8


@pytest.mark.parametrize("engine", ["torch", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_extended_fields_have_both_derivatives(axis: int | None, engine: str):
    """By light, by masses, and by where it comes from; some of what goes on would be negative.

    And by what thick cells receive, of which less comes in than goes out.
    """
    use_engine(engine)
    diffuse, *masses, got = (random_values(1, *GRID.shape, seed=k).pow(4) for k in range(4))
    backward = random_values(1, cells_at_faces(GRID, got).shape[-1], seed=5)
    direction, position = TRAVEL + 0.05, torch.tensor([-0.6, 0.1, 0.2], dtype=torch.float64)

    def extend(diffuse: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
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
