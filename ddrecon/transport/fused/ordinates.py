"""Tables of discrete ordinates for kernels (`ordinates.h`): how each crosses the grid, in teams."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.transport.characteristics import Characteristic, Direction, laps_until
from ddrecon.transport.sweep import sweep_rule

POINTS = 4
"""Cells upwind that light comes from, unless it comes from one."""
MOST = 24
"""Ordinates in a team at most: more read moments less often, fewer leave more of a cache."""

FILL_GPU, FILL_CACHE = 2**18, 2**14
"""Cells of slices at least that a launch by cells does: on a GPU about as many threads as it holds,
on a processor few, since arrays of a chunk have all its slices.
"""


@dataclass(frozen=True)
class Chunk:
    """Ordinates swept side by side: from `first` on, `count` of them, in teams from `team` on.

    By cells all or none of them stay (`Ordinate.stays`).
    """

    first: int
    count: int
    team: int
    teams: int
    stays: bool

    @property
    def ordinates(self) -> slice:
        """Their places in tables."""
        return slice(self.first, self.first + self.count)


@dataclass(frozen=True)
class Tables:
    """Ordinates in the order of kernels: `numbers` in the quadrature set, and what kernels get.

    `chunks` are swept one after another. `arrays`: `teams` [T, 6] and `ordinates` [N, 14] have the
    structs `Team` and `Ordinate` of `ordinates.h`, `paths` [N, 8] the struct `Path`; `values` and
    `weighted` [N, K] are harmonics times the path through a cell, and times quadrature weights;
    `moved` [N, 3] is a part of `paths`.
    """

    numbers: list[int]
    chunks: list[Chunk]
    arrays: dict[str, Tensor]
    most: int


@dataclass(frozen=True)
class Ordinate:
    """How the ordinate `number` of a quadrature set crosses the grid.

    `axis`: that across which its slices lie; `step` [u]: its path through a cell; `moved`: cells
    that it passes along z, y and x meanwhile, with signs. Light comes from four `points`, so many
    cells away, against its senses, with `weights`: the largest first, but across x the point in the
    same row. `laps`: in how many laps through the rows of a plane all that goes around along y has
    come, but for rounding; 0 where it comes from the plane before. It `stays` if it moves along no
    axis where the box ends.
    """

    number: int
    axis: int
    step: float
    moved: tuple[float, ...]
    points: list[tuple[int, ...]]
    weights: list[float]
    laps: int
    stays: bool

    @staticmethod
    def of(grid: Grid, number: int, direction: Direction, rounding: float) -> Ordinate:
        """The ordinate of a `direction` through `grid` (E2.9)."""
        course = Characteristic.of(grid, direction)
        axis, moved = course.order[0] - 1, course.moved

        def weight(point: tuple[int, ...]) -> float:
            return math.prod(abs(m) if p else 1 - abs(m) for m, p in zip(moved, point, strict=True))

        points = list(product(*((1,) if a == axis else (0, 1) for a in range(3))))
        if axis < 2:
            points.sort(key=weight, reverse=True)
        weights = [weight(point) for point in points]
        # Equal paths share decay terms: mirror images have equal ones but for rounding.
        step = float(f"{course.step:.14g}")
        stays = not any(m for a, m in enumerate(moved) if a not in grid.periodic)
        laps = 0
        if axis > 0 and moved[1] and not stays and 1 in grid.periodic:
            # In every row a part of light leaves for the next plane.
            laps = laps_until(1 - abs(moved[0]), grid.shape[1], rounding)
        return Ordinate(number, axis, step, tuple(moved), points, weights, laps, stays)

    @property
    def senses(self) -> list[int]:
        """Along z, y and x, 1 or -1; 1 as well where it does not move."""
        return [-1 if moved < 0 else 1 for moved in self.moved]

    @property
    def turn(self) -> int:
        """In which order of rows, up in y or down, cells upwind are done first; 0: in either."""
        return 0 if self.axis == 0 else (self.moved[1] > 0) - (self.moved[1] < 0)

    def integers(self, width: int) -> list[int]:
        """The struct `Ordinate` for rows of so many cells."""
        _, up, along = self.senses
        count = 1 if self.axis < 2 and self.weights[1] == 0 else POINTS
        backs = [back for back, _, _ in self.points]
        shifts = [up * y * (width + 2) + along * x for _, y, x in self.points]
        return [self.axis, *self.senses, count, *backs, *shifts, self.laps]

    def numbers(self) -> list[float]:
        """The struct `Path`."""
        return [self.step, *(self.step * m for m in self.moved), *self.weights]


@dataclass(frozen=True)
class Team:
    """Ordinates that go through planes together, along z or against it: up in y, and down."""

    sense: int
    up: list[Ordinate]
    down: list[Ordinate]


def _team_rows(ordinates: Sequence[Ordinate], pieces: int) -> list[Team]:
    """Teams for kernels by rows, in pairs along z and against it, and so many `pieces` of these."""
    ways = [[o for o in ordinates if (o.moved > (0, 0, 0)) == is_up] for is_up in (True, False)]
    count = math.ceil(len(ways[0]) / MOST / pieces) * pieces
    teams = list[Team]()
    for n in range(count):
        for sense, way in zip((1, -1), ways, strict=True):
            turns = {turn: [o for o in way[n::count] if o.turn == turn] for turn in (1, -1, 0)}
            # Those that can do either turn with the others, so that rows are read once.
            turns[1 if len(turns[1]) >= len(turns[-1]) else -1] += turns[0]
            up, down = (sorted(turns[turn], key=lambda o: (o.laps > 0, o.step)) for turn in (1, -1))
            teams.append(Team(sense, up, down))
    return teams


def _share_out(teams: Sequence[Team], together: int) -> Iterator[Sequence[Team]]:
    """`teams` in chunks of about so many `together`: few left over would be as many launches."""
    count = max(1, round(len(teams) / together))
    size = max(1, math.ceil(len(teams) / count))
    return (teams[n : n + size] for n in range(0, len(teams), size))


def ordinate_tables(
    grid: Grid, directions: int, like: Tensor, moments: int, pieces: int | None = None
) -> Tables:
    """Tables of a quadrature set of `directions` through `grid`, for so many `moments`.

    They are for kernels by rows, whose teams are `pieces` of the directions, or by cells (None);
    of the type and on the device of `like` [..., C, z, y, x].
    """
    together = 2 * (pieces or 0)
    if pieces is None:
        _, second, largest = sorted(grid.shape)
        items = FILL_GPU if like.is_cuda else FILL_CACHE
        together = math.ceil(items / (like.shape[-4] * second * largest))
    return _make_tables(grid, directions, moments, pieces, together, like.dtype, like.device)


@functools.cache
@torch.inference_mode(False)
def _make_tables(
    grid: Grid,
    directions: int,
    moments: int,
    pieces: int | None,
    together: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Tables:
    """The same, of chunks of about so many teams `together`."""

    def kind(o: Ordinate) -> int:
        return (o.axis in grid.periodic) + o.stays

    points, weights, harmonics = sweep_rule(directions, moments)
    rounding = torch.finfo(dtype).eps
    ordinates = [Ordinate.of(grid, number, point, rounding) for number, point in enumerate(points)]
    if pieces is None:
        # Those that go around are followed again and again, and those that stay most often: they
        # are in chunks of their own.
        kinds = [[o for o in ordinates if kind(o) == n] for n in range(3)]
        groups = [[Team(o.senses[0], [o], []) for o in several] for several in kinds]
    else:
        groups = [_team_rows([o for o in ordinates if not o.stays], pieces)]
    order, rows, chunks = list[Ordinate](), list[list[int]](), list[Chunk]()
    for several in (several for teams in groups for several in _share_out(teams, together)):
        first = len(order)
        for team in several:
            begin, middle = len(order), len(order) + len(team.up)
            order += team.up + team.down
            direct = (sum(not o.laps for o in way) for way in (team.up, team.down))
            around = [place + n for place, n in zip((begin, middle), direct, strict=True)]
            rows.append([begin, middle, len(order), team.sense, *around])
        count, teams = len(order) - first, len(several)
        chunks.append(Chunk(first, count, len(rows) - teams, teams, order[first].stays))
    numbers = [o.number for o in order]
    paths = torch.tensor([o.numbers() for o in order], dtype=torch.float64)
    values, set_weights = harmonics[numbers], harmonics.new_tensor(weights)[numbers, None]
    integers = {"teams": rows, "ordinates": [o.integers(grid.shape[2]) for o in order]}
    tables = {
        "paths": paths,
        "moved": paths[:, 1:4],
        "values": paths[:, :1] * values,
        "weighted": set_weights * values,
    }
    arrays = {
        name: torch.tensor(table, dtype=torch.int32, device=device)
        for name, table in integers.items()
    } | {name: table.to(device, dtype) for name, table in tables.items()}
    team_size = max(end - begin for begin, _, end, *_ in rows)
    return Tables(numbers, chunks, arrays, team_size)
