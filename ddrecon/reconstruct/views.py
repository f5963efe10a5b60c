"""Which training views an iteration looks at."""

from __future__ import annotations

import torch


def pick_views(count: int, wanted: int, iteration: int, seed: int) -> list[int]:
    """The numbers of the views, of `count`, that `iteration` compares.

    They are `wanted` views (0: all). Every view comes once before any comes again, in an order that
    `seed` decides.
    """
    if not 0 < wanted < count:
        return list(range(count))
    # Over a run, views are taken from shuffled passes over all of them, one after another.
    places = range(iteration * wanted, (iteration + 1) * wanted)
    orders = {number: _shuffle(count, seed, number) for number in {i // count for i in places}}
    return [orders[place // count][place % count] for place in places]


def _shuffle(count: int, seed: int, number: int) -> list[int]:
    """The order of `count` views in pass `number` over them."""
    generator = torch.Generator().manual_seed(seed % 2**32 * 1_000_003 + number)
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order
