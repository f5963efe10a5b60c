"""Which rank does what, and how each learns what the others have found.

Ranks share out the views of a scene, or its cells.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from ddrecon.cameras import cast_rays
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box
from ddrecon.ranks import (
    cells_are_shared,
    from_first,
    is_any,
    is_first,
    own_rank,
    rank_count,
    sum_numbers,
    sum_over_ranks,
)
from ddrecon.reconstruct import tuning
from ddrecon.scene import Scene, View
from ddrecon.settings import RenderSettings
from ddrecon.slabs.slab import Slab, own_slab


def require_sharing(scene: Scene) -> None:
    """Raises UsageError where ranks are to share cells, and cannot in `scene`."""
    if not cells_are_shared():
        return
    settings, problems = scene.diffusion, list[str]()
    if settings.model == "flux_limited":
        problems.append("diffusion.model: flux_limited light needs all cells; say p1")
    if settings.scheme == "printed":
        problems.append("diffusion.scheme: the printed scheme needs all cells; say conservative")
    if problems:
        raise UsageError([f"--share cells: {problem}, or share views" for problem in problems])


def has_slabs(scene: Scene) -> bool:
    """Whether ranks share out the cells of `scene`, so that all of them render each view."""
    return isinstance(own_slab(scene.volume.grid), Slab)


def own_views(scene: Scene, names: Sequence[str]) -> list[str]:
    """Those of the views of `scene` called `names` that this rank renders, in their order.

    One that is named twice is rendered twice, by the same rank.
    """
    if rank_count() == 1:
        return list(names)
    owners = _owners(scene, {name: scene.view(name) for name in names}, names)
    return [name for name in names if owners[name] == own_rank()]


def _owners(scene: Scene, views: Mapping[str, View], names: Sequence[str]) -> dict[str, int]:
    """The rank that renders each of `views` of the volume of `scene`, as often as in `names`."""
    costs = [names.count(name) * _known_cost(scene, view) for name, view in views.items()]
    # As the first rank shares them out: another machine may round costs another way.
    return dict(zip(views, from_first(assign(costs, rank_count())), strict=True))


def share_pictures(
    scene: Scene, views: Sequence[View], picture_of: Callable[[View], Tensor]
) -> dict[str, Tensor]:
    """The pictures [3, h, w] of `views` of the volume of `scene`, by name, on all ranks.

    Each is what `picture_of` gives one of them. Of cells in slabs all ranks look at all views.
    """
    if rank_count() == 1 or has_slabs(scene):
        return {view.name: picture_of(view) for view in views}
    names = [view.name for view in views]
    owners = _owners(scene, dict(zip(names, views, strict=True)), names)
    density = scene.volume.density
    pictures = [
        picture_of(view)
        if owners[view.name] == own_rank()
        else density.new_zeros(3, *view.camera.size)
        for view in views
    ]
    return dict(zip(names, sum_over_ranks(pictures), strict=True))


def assign(costs: Sequence[float], ranks: int) -> list[int]:
    """The rank that does each of some jobs with these `costs`, so that all end at about one time.

    The longest jobs are given out first, each to the rank with the least to do (Graham 1969,
    doi:10.1137/0117039): no rank has more than 4/3 of what it must have.
    """
    owners, loads = [0] * len(costs), [0.0] * ranks
    for job in sorted(range(len(costs)), key=lambda job: -costs[job]):
        owners[job] = min(range(ranks), key=lambda rank: loads[rank])
        loads[owners[job]] += costs[job]
    return owners


_KNOWN: WeakKeyDictionary[View, tuple[Grid, RenderSettings, float]] = WeakKeyDictionary()
"""By view, as long as it is there: what its cost was found for, and its cost."""


def _known_cost(scene: Scene, view: View) -> float:
    """`view_cost`, not found again for a view that stays."""
    known = _KNOWN.get(view)
    if known is None or known[:2] != (scene.volume.grid, scene.render):
        known = scene.volume.grid, scene.render, view_cost(scene, view)
        _KNOWN[view] = known
    return known[2]


def view_cost(scene: Scene, view: View) -> float:
    """About how long `view` takes to render, in cells: those that its rays cross, and all once.

    All, because the light that leaves towards a camera is found in each cell.
    """
    grid, camera = scene.volume.grid, view.camera
    coarse = camera.resize(max(1, min(camera.size) // tuning.COARSE))
    with torch.no_grad():
        rays = cast_rays(coarse)
        crossing = cross_box(grid, rays)
        length = float((crossing.far - crossing.near).sum()) / len(rays.direction)
    height, width = camera.size
    on_rays = height * width * scene.render.samples_per_pixel * length / min(grid.spacing)
    return on_rays * scene.render.steps + tuning.CELL_COST * grid.cells


def sum_found(found: Sequence[Tensor | None], likes: Sequence[Tensor]) -> list[Tensor | None]:
    """The sums over ranks of what was `found`; None is zero, and stays where all ranks have it.

    `likes` are of the shapes of `found`.
    """
    if rank_count() == 1:
        return list(found)
    is_found = [count > 0 for count in sum_numbers([one is not None for one in found])]
    chosen = [
        torch.zeros_like(like) if one is None else one
        for one, like, is_any in zip(found, likes, is_found, strict=True)
        if is_any
    ]
    sums = iter(sum_over_ranks(chosen))
    return [next(sums) if is_any else None for is_any in is_found]


def gather_numbers(
    rows: Sequence[Sequence[Tensor]], own: Collection[str], names: Sequence[str]
) -> list[list[Tensor]]:
    """What the ranks have found of views: `rows` of numbers, one of each view called `names`.

    Those given are of this rank's `own` views, in the order of these.
    """
    if rank_count() == 1:
        return [list(row) for row in rows]
    table = torch.zeros(len(rows), len(names), dtype=torch.float64)
    places = [place for place, name in enumerate(names) if name in own]
    for row, numbers in zip(table, rows, strict=True):
        for place, number in zip(places, numbers, strict=True):
            row[place] = number
    return [list(row) for row in sum_over_ranks([table])[0]]


def agree_on(gradients: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The first rank's `gradients` by name.

    Those of others are the same, unless a GPU or another kind of processor adds in another order:
    then they differ by rounding, of which Adam makes whole steps where a derivative is nearly 0.
    """
    if rank_count() == 1:
        return dict(gradients)
    digits = [_digits(gradient) for gradient in gradients.values()]
    if not is_any(digits != from_first(digits)):
        return dict(gradients)
    ours = [gradient if is_first() else 0 * gradient for gradient in gradients.values()]
    return dict(zip(gradients, sum_over_ranks(ours), strict=True))


def _digits(numbers: Tensor) -> int:
    """A sum that differs where `numbers` do, most likely."""
    bits = torch.int32 if numbers.element_size() == 4 else torch.int64
    return int(numbers.contiguous().view(bits).sum())
