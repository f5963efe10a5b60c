"""Cameras: rays go through the pixels they belong to, in array order."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from media import make_camera, make_scene, random_values

from ddrecon.cameras import (
    Camera,
    cast_rays,
    cell_width,
    distort,
    image_places,
    look_at,
    pixel_width,
    project,
    ray_through,
    subpixel_offsets,
    twist,
)
from ddrecon.grid import Grid
from ddrecon.scene import View
from ddrecon.variables.kinds import pose_change

ORIGIN, TARGET, UP = (
    torch.tensor(v, dtype=torch.float64)
    for v in ([1.0, 2.0, 5.0], [0.3, -0.2, 0.1], [0.1, 1.0, 0.2])
)


def camera(size=(3, 5), half_width=0.4, is_perspective=True):
    return Camera(look_at(ORIGIN, TARGET, UP), size, half_width, is_perspective)


def test_a_pose_is_rigid_and_looks_at_its_target():
    pose = look_at(ORIGIN, TARGET, UP)
    right, up, backward, origin = pose.unbind(1)
    turn, middle = pose[:, :3], origin - backward * (TARGET - ORIGIN).norm()
    torch.testing.assert_close(turn.T @ turn, torch.eye(3).double(), rtol=0, atol=1e-15)
    torch.testing.assert_close(torch.linalg.cross(right, up), backward, rtol=0, atol=1e-15)
    torch.testing.assert_close(middle, TARGET, rtol=0, atol=1e-14)
    assert up @ UP > 0 and abs(right @ UP) < 1e-15


@pytest.mark.parametrize(
    ("target", "up"), [(ORIGIN, UP), (TARGET, TARGET - ORIGIN), (TARGET, 3 * (ORIGIN - TARGET))]
)
def test_a_view_without_a_direction_is_refused(target, up):
    with pytest.raises(ValueError, match="do not span a view"):
        look_at(ORIGIN, target, up)


@pytest.mark.parametrize(("aspect", "middle"), [(1.0, (0.5, 0.5)), (1.3, (0.44, 0.63))])
@pytest.mark.parametrize("is_perspective", [True, False])
def test_every_ray_against_explicit_pixel_arithmetic(is_perspective, aspect, middle):
    """Row 0 is the top, column 0 the left, and pixels are as high as said, whatever the shape."""
    view = camera(is_perspective=is_perspective)
    view = replace(view, pixel_aspect=aspect, principal_point=middle)
    bundle = cast_rays(view, (0.25, 0.75))
    right, up, backward, origin = view.pose.unbind(1)
    (height, width), both = view.size, (bundle.origin, bundle.direction)
    for row in range(height):
        for column in range(width):
            x = 2 * ((column + 0.75) / width - middle[0]) * view.half_width
            y = 2 * (middle[1] * height - (row + 0.25)) / width * view.half_width * aspect
            shift = x * right + y * up
            ends = (origin, shift - backward) if is_perspective else (origin + shift, -backward)
            place, way = (part[row * width + column].flip(0) for part in both)
            torch.testing.assert_close(place, ends[0], rtol=0, atol=1e-14)
            torch.testing.assert_close(way, ends[1] / ends[1].norm(), rtol=0, atol=1e-15)


def test_only_perspective_rays_meet():
    assert cast_rays(camera(is_perspective=False)).eye is None
    torch.testing.assert_close(cast_rays(camera()).eye, ORIGIN.flip(0), rtol=0, atol=0)


@pytest.mark.parametrize("is_perspective", [True, False])
def test_corners_stay_where_they_are_in_a_smaller_picture(is_perspective):
    """Also where its size is no whole fraction, and whatever the principal point."""
    view = camera((7, 11), is_perspective=is_perspective)
    view = replace(view, principal_point=(0.3, 0.6), pixel_aspect=1.1)
    assert view.resize(100).size == (1, 1)
    for factor in (2, 3, 100):
        for corner, index in (((0.0, 0.0), 0), ((1.0, 1.0), -1)):
            small, large = cast_rays(view.resize(factor), corner), cast_rays(view, corner)
            for name, error in (("direction", 1e-15), ("origin", 1e-14)):
                one, other = (getattr(rays, name)[index] for rays in (small, large))
                torch.testing.assert_close(one, other, rtol=0, atol=error)


def test_a_camera_in_the_middle_sees_cells_as_from_a_face():
    grid = Grid((4, 4, 4), (0.0, 0.0, 0.0), (2.0, 3.0, 4.0))
    scene = make_scene(random_values(4, 4, 4), grid=grid)
    middle, face = (make_camera((*grid.center_xyz[:2], z)) for z in (1.0, 2.0))
    assert cell_width(grid, middle) == pytest.approx(cell_width(grid, face))
    scene.views = [View("in", middle), View("on", face)]
    changes = [pose_change(scene, f"views.{v.name}.camera", v.camera.pose) for v in scene.views]
    torch.testing.assert_close(*changes)


@pytest.mark.parametrize("is_perspective", [True, False])
def test_a_pixel_is_as_wide_as_the_way_to_the_next_one(is_perspective):
    """Also far away, where parallel rays are no farther apart."""
    seen = camera(is_perspective=is_perspective)
    right, _, backward, origin = seen.pose.unbind(1)
    for distance in (0.5, 3.0, 40.0):
        point = origin - distance * backward
        beside = point + pixel_width(seen, point, 0.0) * right
        (before, after), _ = project(seen, torch.stack([point, beside]))
        torch.testing.assert_close(after - before, torch.tensor([1.0, 0.0]).double())


@given(st.integers(1, 64))
def test_samples_share_no_row_and_no_column(samples):
    offsets = torch.tensor(subpixel_offsets(samples), dtype=torch.float64)
    centers = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples
    for places in offsets.unbind(1):
        torch.testing.assert_close(places.sort().values, centers)


@pytest.mark.parametrize("samples", (4, 16, 64, 100, 1024))
def test_samples_cover_a_pixel_evenly(samples):
    """No empty disk, around the pixel's edges, is much larger than that of a square grid."""
    offsets = torch.tensor(subpixel_offsets(samples), dtype=torch.float64)
    probes = torch.rand(500, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    away = (probes[:, None] - offsets).abs()
    nearest = torch.minimum(away, 1 - away).norm(dim=-1).amin(1)
    assert nearest.max() < 1.35 * (0.5 / samples) ** 0.5


# --- twists ---

PIVOT = (0.2, -0.1, 0.4)
small_twists = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(
    lambda entries: torch.tensor(entries, dtype=torch.float64)
)


@given(small_twists)
def test_a_twisted_pose_is_rigid(change):
    turn = twist(camera(), change, PIVOT).pose[:, :3]
    torch.testing.assert_close(turn.T @ turn, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-13)
    assert torch.linalg.det(turn) > 0


@given(small_twists)
def test_a_turn_keeps_the_pivot_where_the_camera_sees_it(change):
    """Only a shift moves the pivot in the camera's own frame, by just as much the other way."""
    pivot = torch.tensor(PIVOT, dtype=torch.float64)

    def seen(view):
        return view.pose[:, :3].T @ (pivot - view.pose[:, 3])

    turn = change.clone()
    turn[3:] = 0
    shift, known = change - turn, seen(camera())
    turned, shifted = (seen(twist(camera(), each, PIVOT)) for each in (turn, shift))
    torch.testing.assert_close(turned, known, rtol=0, atol=1e-13)
    torch.testing.assert_close(shifted, known - shift[3:], rtol=0, atol=1e-13)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotation_vector_turns_by_its_length_about_its_axis_right_handed(axis):
    """A quarter turn about a camera axis takes the next axis to the one after it."""
    change = torch.zeros(6, dtype=torch.float64)
    change[axis] = math.pi / 2
    before, after = camera().pose, twist(camera(), change, PIVOT).pose
    torch.testing.assert_close(after[:, axis], before[:, axis], rtol=0, atol=1e-13)
    following, next_one = after[:, (axis + 1) % 3], before[:, (axis + 2) % 3]
    torch.testing.assert_close(following, next_one, rtol=0, atol=1e-13)


LENSES = {
    "opencv": [-0.25, 0.08, -0.01, 0.004, 0.002, -0.003],
    "fisheye": [0.04, -0.006, 6e-4, -2e-5],
}


def lens_of(model, dtype=torch.float64):
    return torch.tensor(LENSES[model], dtype=dtype)


def plainly(model, k, x, y, z):
    """The image of a direction, as OpenCV's manual writes it; k4 of `opencv` as nerfstudio's."""
    a, b = x / z, y / z
    if model == "opencv":
        k1, k2, k3, k4, p1, p2 = k
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
        return (
            a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
            b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
        )
    r = math.hypot(a, b)
    theta = math.atan(r)
    bent = theta * (1 + sum(c * theta ** (2 * n + 2) for n, c in enumerate(k)))
    return (bent / r * a, bent / r * b) if r else (0.0, 0.0)


@pytest.mark.parametrize("model", LENSES)
def test_a_direction_meets_the_image_where_the_manual_says(model):
    rays = [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.5, 0.4, 1.2), (0.01, 0.6, 0.9)]
    distorted = distort(model, lens_of(model), torch.tensor(rays, dtype=torch.float64))
    expected = [plainly(model, LENSES[model], *ray) for ray in rays]
    torch.testing.assert_close(distorted, torch.tensor(expected).to(distorted), rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("model", LENSES)
def test_there_and_back(model, dtype):
    """To rounding, from the axis to the corners; for a fisheye also sideways and behind."""
    steps = torch.linspace(-0.7, 0.7, 15, dtype=dtype)
    places = torch.cartesian_prod(steps, steps) * (3.0 if model == "fisheye" else 1.0)
    rays = ray_through(model, lens_of(model, dtype), places)
    again = distort(model, lens_of(model, dtype), rays)
    torch.testing.assert_close(again, places, rtol=0, atol=30 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("model", LENSES)
def test_derivatives_are_those_of_the_inverse(model):
    """In both modes; on the axis too, where a fisheye's angle has a kink that its rays have not."""
    places = torch.tensor([[0.0, 0.0], [0.4, -0.3], [-0.1, 0.5]], dtype=torch.float64)
    inputs = (lens_of(model).requires_grad_(), places.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda *given: ray_through(model, *given), inputs, check_forward_ad=True, atol=1e-7
    )


def lens_camera(model, **changes):
    distortion = None if model is None else lens_of(model)
    camera = make_camera(size=(40, 36), half_width=0.35)
    return replace(camera, lens=model, distortion=distortion, **changes)


@pytest.mark.parametrize("model", LENSES)
def test_rays_of_pixels(model):
    """Off-center axis and oblong pixels; a coarser image has the same rays at its corners."""
    camera = lens_camera(model, principal_point=(0.45, 0.53), pixel_aspect=1.1)
    right, up, backward = camera.pose[:, :3].unbind(1)
    direction = cast_rays(camera).direction.flip(1)
    ray = torch.stack([direction @ right, -direction @ up, -direction @ backward], 1)
    distorted = distort(model, lens_of(model), ray)
    torch.testing.assert_close(distorted, image_places(camera), rtol=0, atol=1e-14)
    coarse = cast_rays(camera.resize(2), (0.0, 0.0)).direction[19]
    torch.testing.assert_close(coarse, cast_rays(camera, (0.0, 0.0)).direction[36 * 2 + 2])


@pytest.mark.parametrize("model", [None, *LENSES])
def test_a_point_is_found_in_the_largest_picture(model):
    """Of 2^28 pixels, whose rays alone would take gigabytes."""
    whole = lens_camera(model, size=(1, 1), principal_point=(0.45, 0.53))
    side = 2.0**14
    places = torch.tensor([[0.5, 0.5], [side - 0.5, 0.5], [9e3, 4e3]], dtype=torch.float64)
    rays = cast_rays(whole, *((row, column) for column, row in (places / side).tolist()))
    points = (rays.origin + 2 * rays.direction).flip(1)
    seen, _ = project(replace(whole, size=(2**14, 2**14)), points)
    torch.testing.assert_close(seen, places, rtol=0, atol=1e-9)
