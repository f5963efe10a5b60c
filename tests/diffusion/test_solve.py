"""The solver reaches its tolerance for every color, and says where it cannot."""

import pytest
import torch
from media import box_grid, make_operator, random_values
from torch import Tensor

from ddrecon.diffusion import solve
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.errors import SolveError

SHAPE = (4, 5, 3)
TOLERANCES = {torch.float32: 1e-5, torch.float64: 1e-11}
each_dtype = pytest.mark.parametrize("dtype", TOLERANCES, ids=str)


@pytest.fixture
def system():
    """A source, and an operator: one color of equal conductances, and one that spans `contrast`."""

    def make(dtype: torch.dtype, contrast: float = 1e3, colors: int = 2) -> tuple[Operator, Tensor]:
        spread = torch.linspace(0, 1, colors, dtype=torch.float64).view(-1, 1, 1, 1)
        diffusion = 0.1 * contrast ** -(spread * random_values(colors, *SHAPE, seed=1))
        operator = make_operator(
            box_grid(SHAPE),
            diffusion.to(dtype),
            (0.1 * random_values(colors, *SHAPE, seed=2)).to(dtype),
        )
        return operator, random_values(colors, *SHAPE, seed=3, dtype=dtype)

    return make


def relative_residual(operator: Operator, u: Tensor, source: Tensor) -> float:
    """The residual promised: by diagonal^(-1/2), relative to the source, largest over colors."""
    operator = Operator(tuple(c.double() for c in operator.conductances), operator.loss.double())
    source, scale = source.double(), operator.diagonal.rsqrt()
    residual = (scale * (source - operator.apply(u.double()))).flatten(1).norm(dim=1)
    return float((residual / (scale * source).flatten(1).norm(dim=1)).max())


@each_dtype
@pytest.mark.parametrize("contrast", [1.0, 1e3, 1e6])
def test_the_residual_is_reached(dtype: torch.dtype, contrast: float, system):
    operator, source = system(dtype, contrast)
    solution = solve_by_multigrid(operator, source, None, TOLERANCES[dtype])
    assert solution.residual <= TOLERANCES[dtype] and solution.iterations > 0
    assert relative_residual(operator, solution.value, source) < 2 * TOLERANCES[dtype]


def test_colors_do_not_mix(system):
    operator, source = system(torch.float64, 1e6, colors=3)
    together = solve_by_multigrid(operator, source, None, 1e-11).value
    for c in range(3):
        one = Operator(tuple(k[c : c + 1] for k in operator.conductances), operator.loss[c : c + 1])
        torch.testing.assert_close(
            solve_by_multigrid(one, source[c : c + 1], None, 1e-11).value,
            together[c : c + 1],
            rtol=1e-8,
            atol=0,
        )


@each_dtype
def test_starting_from_the_solution_takes_no_iteration(dtype: torch.dtype, system):
    operator, source = system(dtype)
    solved = solve_by_multigrid(operator, source, None, TOLERANCES[dtype]).value
    again = solve_by_multigrid(operator, source, solved, 10 * TOLERANCES[dtype])
    assert again.iterations == 0
    torch.testing.assert_close(again.value, solved)


@pytest.mark.parametrize("is_fitting", [True, False])
def test_a_useless_start_does_no_harm(is_fitting: bool, system):
    """A guess that is worse than zero, or of another grid, is not used."""
    operator, source = system(torch.float64)
    guess = 1e9 * random_values(*source.shape) if is_fitting else random_values(2, 3, 3, 3)
    assert torch.equal(
        solve_by_multigrid(operator, source, guess, 1e-8).value,
        solve_by_multigrid(operator, source, None, 1e-8).value,
    )


def test_no_source_no_light(system):
    operator, source = system(torch.float64)
    solution = solve_by_multigrid(operator, torch.zeros_like(source), None, 1e-8)
    assert solution.iterations == 0 and solution.residual == 0 and not solution.value.any()


def test_a_solve_that_does_not_converge_says_so(system, monkeypatch):
    operator, source = system(torch.float64)
    monkeypatch.setattr(solve, "MAX_ITERATIONS", 1)
    with pytest.raises(SolveError, match="multigrid did not reach") as caught:
        solve_by_multigrid(operator, source, None, 1e-12)
    assert 0 < caught.value.iterations <= 100 and caught.value.residual > 1e-12


@pytest.mark.parametrize("where", ["source", "loss"])
def test_a_system_that_is_not_finite_is_an_error(where: str, system, monkeypatch):
    operator, source = system(torch.float64)
    {"source": source, "loss": operator.loss}[where][0, 0, 0, 0] = float("nan")
    monkeypatch.setattr(solve, "MAX_ITERATIONS", 50)
    with pytest.raises(SolveError):
        solve_by_multigrid(operator, source, None, 1e-8)
