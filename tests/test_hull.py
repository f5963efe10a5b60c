"""A box is compared with what pictures show: how they differ, why, and what to write."""

from collections.abc import Callable

import pytest
import torch

from ddrecon.hull import bounds_text, doubt_box

BOX = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.8, 0.5]])
SMOKE = torch.tensor([[0.1, 0.1, 0.12], [0.4, 0.6, 0.4]])
Y, Z = 1, 2


def stand_on_z(box: torch.Tensor) -> torch.Tensor:
    """The same where z is up, as Blender has it: (x, y, z) has come to be (x, -z, y)."""
    return torch.stack([box[:, 0], -box[:, 2], box[:, 1]], 1).sort(0).values


FAULTS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], int, list[str]]] = {
    "none": (lambda box: box, Y, []),
    "moved": (lambda box: box + torch.tensor([0.0, 0.0, -0.5]), Y, ["no overlap"]),
    "hardly there": (
        lambda box: box - torch.tensor([0.0, 0.0, 0.39]),
        Y,
        ["hardly any overlap", "3.6 %"],
    ),
    "cut": (lambda box: box - torch.tensor([0.0, 0.4, 0.0]), Y, ["cut off", "below 0 along y"]),
    "cut on all sides": (
        lambda _: torch.tensor([[0.05, 0.0, 0.05], [1.2, 1.6, 1.2]]),
        Y,
        ["cut off"],
    ),
    "long": (lambda box: 1000 * box, Y, ["no overlap", "lengths of the cameras times 0.001,"]),
    "short": (lambda box: box / 100, Y, ["far too large", "lengths of the cameras times 100,"]),
    "small": (lambda box: 10 * (box - 0.25), Y, ["far too small"]),
    "z up": (stand_on_z, Z, ["no overlap", "(x, z, -y) of the cameras", "and up: z"]),
    "tall along z": (stand_on_z, Y, ["no overlap", "(x, z, -y) of the cameras"]),
    "both": (lambda box: stand_on_z(1000 * box), Z, ["(x, z, -y)", "times 0.001,"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_box_that_is_off_is_told_with_what_it_is_and_what_to_write(fault: str) -> None:
    change, up, words = FAULTS[fault]
    shown = change(SMOKE)
    told = doubt_box(shown, BOX, (up, Y))
    assert (told is None) == (not words)
    for word in words:
        assert word in str(told) and bounds_text(shown) in str(told)
    for other in ("times", "(x, z, -y)"):
        assert (other in str(told)) == any(other in word for word in words)
