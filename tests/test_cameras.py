"""Cameras: rays go through the pixels they belong to, in array order."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.cameras import Camera, cast_rays, look_at, subpixel_offsets, twist

ORIGIN, TARGET, UP = (
    torch.tensor(v, dtype=torch.float64)
    for v in ([1.0, 2.0, 5.0], [0.3, -0.2, 0.1], [0.1, 1.0, 0.2])
)


def camera(
    size: tuple[int, int] = (3, 5), half_width: float = 0.4, is_perspective: bool = True
) -> Camera:
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
def test_a_view_without_a_direction_is_refused(target: torch.Tensor, up: torch.Tensor):
    with pytest.raises(ValueError, match="do not span a view"):
        look_at(ORIGIN, target, up)


@pytest.mark.parametrize(("aspect", "middle"), [(1.0, (0.5, 0.5)), (1.3, (0.44, 0.63))])
@pytest.mark.parametrize("is_perspective", [True, False])
def test_every_ray_against_explicit_pixel_arithmetic(
    is_perspective: bool, aspect: float, middle: tuple[float, float]
):
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
def test_corners_stay_where_they_are_in_a_smaller_picture(is_perspective: bool):
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


@given(st.integers(1, 64))
def test_samples_are_centers_of_equal_parts(samples: int):
    offsets = torch.tensor(subpixel_offsets(samples), dtype=torch.float64)
    assert len({(round(a, 9), round(b, 9)) for a, b in offsets.tolist()}) == samples
    assert offsets.mean(0).tolist() == pytest.approx([0.5, 0.5], abs=1e-14)
    rows, columns = (len(set(line.tolist())) for line in offsets.unbind(1))
    assert rows * columns == samples
    second_moments = ((offsets - 0.5) ** 2).mean(0)
    expected = [(1 - 1 / count**2) / 12 for count in (rows, columns)]
    assert second_moments.tolist() == pytest.approx(expected, abs=1e-14)


# --- twists ---

PIVOT = (0.2, -0.1, 0.4)
small_twists = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(
    lambda entries: torch.tensor(entries, dtype=torch.float64)
)


@given(small_twists)
def test_a_twisted_pose_is_rigid(change: torch.Tensor):
    turn = twist(camera(), change, PIVOT).pose[:, :3]
    torch.testing.assert_close(turn.T @ turn, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-13)
    assert torch.linalg.det(turn) > 0


@given(small_twists)
def test_a_turn_keeps_the_pivot_where_the_camera_sees_it(change: torch.Tensor):
    """Only a shift moves the pivot in the camera's own frame, by just as much the other way."""
    pivot = torch.tensor(PIVOT, dtype=torch.float64)

    def seen(view: Camera) -> torch.Tensor:
        return view.pose[:, :3].T @ (pivot - view.pose[:, 3])

    turn = change.clone()
    turn[3:] = 0
    shift, known = change - turn, seen(camera())
    turned, shifted = (seen(twist(camera(), each, PIVOT)) for each in (turn, shift))
    torch.testing.assert_close(turned, known, rtol=0, atol=1e-13)
    torch.testing.assert_close(shifted, known - shift[3:], rtol=0, atol=1e-13)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotation_vector_turns_by_its_length_about_its_axis_right_handed(axis: int):
    """A quarter turn about a camera axis takes the next axis to the one after it."""
    change = torch.zeros(6, dtype=torch.float64)
    change[axis] = math.pi / 2
    before, after = camera().pose, twist(camera(), change, PIVOT).pose
    torch.testing.assert_close(after[:, axis], before[:, axis], rtol=0, atol=1e-13)
    following, next_one = after[:, (axis + 1) % 3], before[:, (axis + 2) % 3]
    torch.testing.assert_close(following, next_one, rtol=0, atol=1e-13)
