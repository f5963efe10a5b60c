"""A box is compared with what pictures show: how they differ, why, and what to write."""

from collections.abc import Callable

import pytest
import torch

from ddrecon.hull import bounds_text, doubt_box

BOX = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.8, 0.5]])
SMOKE = torch.tensor([[0.1, 0.1, 0.12], [0.4, 0.6, 0.4]])
FAULTS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], list[str]]] = {
    "none": (lambda box: box, []),
    "moved": (lambda box: box + torch.tensor([0.0, 0.0, -0.5]), ["no overlap"]),
    "hardly there": (
        lambda box: box - torch.tensor([0.0, 0.0, 0.39]),
        ["hardly any overlap", "3.6 %"],
    ),
    "cut": (lambda box: box - torch.tensor([0.0, 0.4, 0.0]), ["cut off", "below 0 along y"]),
    "cut on all sides": (
        lambda _: torch.tensor([[0.05, 0.0, 0.05], [1.2, 1.6, 1.2]]),
        ["cut off"],
    ),
    "short": (lambda box: box / 100, ["far too large"]),
    "small": (lambda box: 10 * (box - 0.25), ["far too small"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_box_that_is_off_is_doubted_and_a_better_one_named(fault: str) -> None:
    change, words = FAULTS[fault]
    shown = change(SMOKE)
    doubt = doubt_box(shown, BOX)
    assert (doubt is None) == (not words)
    for word in words:
        assert word in str(doubt) and bounds_text(shown) in str(doubt)
