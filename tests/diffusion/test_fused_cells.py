"""Fused kernels of D, system and flux compute what torch does: values and cotangents."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from graphics_cards import assert_compiles
from media import box_grid, half_empty, random_values
from torch import Tensor
from twins import Function, Tensors, assert_twins

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.medium.coefficients import Volume, scale_medium

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.diffusion.fused import faces
from ddrecon.kernels.cell_function import RowFunction

pytestmark = pytest.mark.slow

Shape = tuple[int, int, int]
COLORS = [(1, 1), (1, 3), (3, 3)]
"""Of the medium and of the light."""


def system_and_flux(shape: Shape, periodic: tuple[int, ...] = ()) -> Function:
    """All that a diffusion problem is asked for, as a function of medium, source and light."""
    grid = replace(box_grid(shape), periodic=periodic)

    def find(values: Tensors) -> list[Tensor]:
        medium = [values[name] for name in ("density", "sigma_a", "sigma_s", "g")]
        scaled, closure = scale_medium(Volume(grid, *medium)), lambda k: 1 / (3 * k + 0.5)
        problem = DiffusionProblem(scaled, closure, values["source"], values["outside"], True)
        (operator, right), mean = problem.system, values["mean"]
        flux = problem.flux(mean)
        off = problem.flux(mean, more=flux.roll(1, 0), before=flux.roll(2, 0))
        side = problem.right_side(mean, flux)
        return [*operator.conductances, operator.loss, right, flux, off, side]

    return find


def values_of(
    shape: Shape, colors: tuple[int, int], has_fields: bool = False, is_directed: bool = True
) -> Tensors:
    cells, (of_medium, of_light) = shape if has_fields else (), colors
    sources = random_values(4 if is_directed else 1, *shape, of_light, seed=11)
    return {
        "density": 5 * half_empty(*shape),
        "sigma_a": random_values(of_medium, *cells, seed=7),
        "sigma_s": 6 * random_values(of_medium, *cells, seed=8),
        "g": torch.tensor(0.4, dtype=torch.float64),
        "source": sources.movedim(-1, 1),
        "outside": random_values(of_light, 1, 1, 1, seed=3),
        "mean": random_values(of_light, *shape, seed=5),
    }


@pytest.mark.parametrize("shape", [(5, 7, 19), (1, 4, 3), (3, 1, 1)], ids=str)
@pytest.mark.parametrize("colors", COLORS, ids=str)
@pytest.mark.parametrize("has_fields", [False, True])
@pytest.mark.parametrize("is_directed", [False, True])
def test_systems_and_fluxes_agree(
    shape: Shape, colors: tuple[int, int], has_fields: bool, is_directed: bool
):
    values, find = values_of(shape, colors, has_fields, is_directed), system_and_flux(shape)
    assert_twins(find, values, least=1e-2)
    if colors == COLORS[-1] and (has_fields, is_directed) == (False, True):
        single = {name: value.float() for name, value in values.items()}
        assert_twins(find, single, 1e-5, least=1e-2)


@pytest.mark.parametrize(("shape", "periodic"), [((5, 4, 9), (0, 2)), ((3, 4, 1), (1, 2))])
def test_around_a_period_they_agree(shape: Shape, periodic: tuple[int, ...]):
    assert_twins(system_and_flux(shape, periodic), values_of(shape, (1, 3)), least=1e-2)


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    place = 1, faces.PLACE, faces.GIVEN
    system = RowFunction(faces.HEADER, "Flow<SYSTEM, 1, 0>", ((),) * 5, *place)
    flux = RowFunction(faces.HEADER, "Flow<FLUX, 1, 3>", ((3, 1, 1, 1, 1),), *place)
    assert_compiles([system.kernel("tangents", 7, 32), flux.kernel("values", 9, 64)], tmp_path)
