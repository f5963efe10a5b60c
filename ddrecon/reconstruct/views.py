"""Which training views an iteration looks at."""

from __future__ import annotations

import torch


def pick_views(count: int, wanted: int, iteration: int, seed: int) -> list[int]:
    """Which of `count` views `iteration` looks at: `wanted` of them (0: all), every view once
    before any comes again, ordered by `seed`.
    """
    if not 0 < wanted < count:
        return list(range(count))
    seed, places = seed % 2**32, range(iteration * wanted, (iteration + 1) * wanted)
    rounds = {place // count for place in places}
    orders = {
        turn: torch.randperm(
            count, generator=torch.Generator().manual_seed(seed * 1_000_003 + turn)
        ).tolist()
        for turn in rounds
    }
    return [orders[place // count][place % count] for place in places]
