"""The fused kernels of a sweep compute what PyTorch's operations compute, derivatives included."""

import functools
import math
from dataclasses import dataclass, replace

import pytest
import torch
from media import half_empty, random_values
from twins import assert_same, assert_twins, differentiate

from ddrecon.diffusion.cells import average_cells
from ddrecon.grid import Grid
from ddrecon.light.moments import cut
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.transport.fused import ordinates
from ddrecon.transport.rounds import face_mirror
from ddrecon.transport.sweep import sweep_change

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from as_on_a_gpu import as_on_a_gpu

pytestmark = pytest.mark.slow

CUBES, FLAT, THIN = (1.0, 1.0, 1.0), (0.2, 1.0, 3.0), (3.0, 1.0, 0.2)
"""Spacings [u]: along most of 26 directions rays then drift by whole cells, or by parts of them.

In flat cells most go through slices across z, in thin ones across x.
"""


@dataclass(frozen=True)
class Case:
    """What is swept: `depth` is that of the densest cells; fields `vary` by cell and color.

    `moments`: of what scatters; `known`: of light before; `directions`: how many. An island
    has a medium in a few cells amid empty ones.
    """

    shape: tuple[int, int, int] = (5, 7, 6)
    spacing: tuple[float, float, float] = FLAT
    colors: int = 3
    moments: int = 16
    known: int = 64
    is_lit: bool = True
    varies: bool = False
    directions: int = 26
    depth: float = 3.0
    dtype: torch.dtype = torch.float64
    is_island: bool = False
    periodic: tuple[int, ...] = ()
    index: float = 1.0
    halved: str = ""

    @property
    def grid(self):
        z, y, x = (n * step for n, step in zip(self.shape, self.spacing, strict=True))
        return Grid(self.shape, (0.0, 0.0, 0.0), (z, y, x), periodic=self.periodic)

    def values(self):
        """All that a sweep depends on, by name."""

        def random(*shape, seed):
            return random_values(*shape, seed=seed, dtype=self.dtype)

        found = {"density": self.depth * half_empty(*self.shape, dtype=self.dtype)}
        if self.is_island:
            island = torch.zeros_like(found["density"])
            island[3:5, 2:5, self.shape[2] // 2 :][..., :4] = self.depth
            found["density"] = island
        per_cell = self.shape if self.varies else ()
        found["sigma_a"] = 0.1 + random(self.colors, *per_cell, seed=1)
        found["sigma_s"] = 0.5 + random(self.colors, *per_cell, seed=2)
        if self.moments > 1:
            found["g"] = torch.tensor(0.4, dtype=self.dtype)
        for seed, (name, count) in enumerate({"source": self.moments, "light": self.known}.items()):
            moments = random(min(count, self.moments), self.colors, *self.shape, seed=3 + seed)
            moments[0] += 1.5
            found[name] = moments - 0.5
        if self.is_lit:
            found["inflow"] = random(self.colors, 1, 1, 1, seed=7)
        return found

    def medium(self, values):
        density, sigma_a, sigma_s = (values[name] for name in ("density", "sigma_a", "sigma_s"))
        g = values.get("g", density.new_zeros(()))
        volume = Volume(self.grid, density, sigma_a, sigma_s, g, index=self.index)
        medium = scale_medium(volume, max(1, math.isqrt(self.moments) - 1))
        return average_cells(replace(medium, halved=self.halved)) if self.halved else medium


def moments_of(case):
    """The moments of the change that a sweep finds, of all that it depends on."""

    def find(values):
        medium = case.medium(values)
        lights = cut(values["light"]), cut(values["source"])
        # What faces reflect has left them in the sweep before.
        mirror = face_mirror(medium, case.directions)
        sweeps = [
            torch.cat(sweep_change(medium, *lights, values.get("inflow"), case.directions, mirror))
            for _ in range(1 if mirror is None else 2)
        ]
        return [sum(sweeps[1:], sweeps[0])]

    return find


def found_of(case, engine="warp"):
    return differentiate(engine, moments_of(case), case.values())


known_of = functools.cache(functools.partial(found_of, engine="torch"))


CASES = {
    "color": Case(),
    "begun": Case(known=4),
    "cubes": Case(spacing=CUBES, directions=50),
    "thin": Case(spacing=THIN),
    "gray": Case(colors=1, moments=1, is_lit=False),
    "fields": Case(varies=True, moments=1),
    "44": Case(directions=44, moments=36, spacing=CUBES),
    "wide": Case((3, 4, 35), CUBES),
    "wider": Case((3, 4, 70), THIN, directions=44, colors=1),
    "line-x": Case((1, 1, 9)),
    "line-y": Case((1, 9, 1), CUBES),
    "line-z": Case((19, 1, 1), CUBES),
    "sheet": Case((4, 1, 5), CUBES),
    "cell": Case((1, 1, 1), CUBES),
    "opaque": Case(depth=1e4, spacing=CUBES),
    "empty": Case(depth=0.0),
    "island-slanted": Case((7, 8, 70), FLAT, colors=1, is_island=True),
    "island-high": Case((25, 40, 7), colors=1, moments=1, is_island=True),
    "around-zx": Case((3, 4, 5), periodic=(0, 2)),
    "around-cubes": Case(periodic=(0, 1), spacing=CUBES, colors=1, varies=True),
    "around-yx": Case(periodic=(1, 2), directions=44),
    "around-y": Case((3, 4, 5), CUBES, periodic=(1,), directions=96, moments=4),
    "around-x": Case((4, 3, 5), THIN, periodic=(2,), directions=44),
    "around-few": Case((3, 2, 2), CUBES, periodic=(1, 2), directions=44, depth=0.05),
    "around-empty": Case((4, 5, 3), (0.5, 2.0, 1.9), periodic=(1, 2), directions=96, depth=0.0),
    "halves": Case((3, 4, 5), periodic=(1, 2), directions=44, halved="xy"),
    "refracting": Case(index=1.4, known=4),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_moments_and_gradients_are_those_of_torch(case):
    assert_same(found_of(case), known_of(case), 1e-12)


@pytest.mark.parametrize("spacing", [CUBES, FLAT], ids=str)
def test_single_precision(spacing):
    """Beside the same numbers in double precision; rows have two vectors and a rest."""
    case = Case((4, 5, 37), spacing)
    assert_same(found_of(replace(case, dtype=torch.float32)), known_of(case), 2e-6)


@pytest.mark.parametrize("varied", [["source"], ["density", "inflow"]], ids=str)
def test_some_derivatives_are_asked_for(varied):
    values = Case().values()
    some = {name: values[name] for name in varied}
    assert_twins(lambda given: moments_of(Case())(values | given), some)


@pytest.mark.parametrize("case", [Case(directions=44), Case((5, 6, 7), CUBES, colors=1)], ids=str)
def test_it_does_not_matter_which_ordinates_go_together(case, monkeypatch):
    """Few or all in a chunk, in one thread or in pieces of their own in many."""
    together = found_of(case)
    monkeypatch.setattr(ordinates, "MOST", 3)
    ordinates._make_tables.cache_clear()
    assert_same(found_of(case), together, 1e-13)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    assert_same(found_of(case), together, 1e-13)
    ordinates._make_tables.cache_clear()


@pytest.mark.parametrize("fill", [1, 200, 10**6])
def test_chunks_by_cells_may_have_any_size(fill, monkeypatch):
    for name in ("FILL_GPU", "FILL_CACHE"):
        monkeypatch.setattr(ordinates, name, fill)
    case = Case((3, 4, 5), periodic=(0,), directions=18)
    assert_same(found_of(case), known_of(case), 1e-12)


@pytest.mark.parametrize("name", ["44", "around-zx", "refracting"])
def test_cells_of_a_slice_may_be_done_in_any_order(name):
    """Of what `tests/kernels/test_as_on_a_gpu.py` has not."""
    with as_on_a_gpu("scattered"):
        found = found_of(CASES[name])
    assert_same(found, known_of(CASES[name]), 1e-12)
