"""Small random media, operators, cameras and scenes."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.graph import saved_tensors_hooks

from ddrecon.cameras import Camera, Rays, look_at
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, conductance
from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight
from ddrecon.march.integral import march
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.sight import look_along
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import SeenPhase, peaked_series
from ddrecon.numerics.series import legendre
from ddrecon.picture import render
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.values import value_of, with_values

LOWER, UPPER = (-0.5, -0.6, -0.4), (0.5, 0.6, 0.5)
"""A box, in array order, whose cells are not cubes."""


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def random_values(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype)


def half_empty(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return (2 * random_values(*shape, seed=seed, dtype=dtype) - 1).clamp(min=0)


def assert_near(found: Tensor, known: Tensor, error: float) -> None:
    """To `error` of the largest known."""
    assert float((found - known).abs().max()) <= error * float(known.abs().max())


def box_grid(shape: tuple[int, int, int]) -> Grid:
    return Grid(shape, LOWER, UPPER)


def make_camera(
    eye: tuple[float, float, float] = (0.2, 0.3, 2.5),
    size: tuple[int, int] = (4, 5),
    half_width: float = 0.3,
    *,
    is_perspective: bool = True,
    **kind: Any,
) -> Camera:
    """A camera at `eye` (x, y, z) looking at the origin."""
    origin = torch.tensor(eye, dtype=kind.get("dtype", torch.float64))
    pose = look_at(origin, torch.zeros_like(origin), origin.new_tensor([0.0, 1.0, 0.0]))
    return Camera(pose, size, half_width, is_perspective)


def light_of(
    radiance: Tensor, scale: float = 1.0, rotation: float = 0.0, directions: int = 48, up: str = "y"
) -> EnvironmentLight:
    """The light of a map `radiance` [C, h, w]."""
    numbers = radiance.new_tensor(scale), radiance.new_tensor(rotation)
    return EnvironmentLight(radiance, *numbers, directions, up)


def make_scene(
    density: Tensor,
    *,
    sigma_a: Any = (0.5, 1.0, 2.0),
    sigma_s: Any = (8.0, 6.0, 4.0),
    g: float = 0.0,
    directional: tuple[float, ...] | None = (3.0,),
    travel: tuple[float, float, float] = (-2.0, -2.0, -1.0),
    ambient: tuple[float, ...] | None = None,
    camera: Camera | None = None,
    grid: Grid | None = None,
    emission: Tensor | None = None,
    **diffusion: Any,
) -> Scene:
    """A scene in the precision of `density`, solved closely; without rounds, unless asked for."""
    grid = grid or box_grid((density.shape[0], density.shape[1], density.shape[2]))
    tensor = density.new_tensor
    sigma_a, sigma_s = (
        sigma if isinstance(sigma, Tensor) else tensor(sigma) for sigma in (sigma_a, sigma_s)
    )
    lights: list[Any] = []
    lights += [DirectionalLight(tensor(travel), tensor(directional))] if directional else []
    lights += [AmbientLight(tensor(ambient))] if ambient else []
    camera = camera or make_camera(dtype=density.dtype)
    tolerance = 1e-13 if density.dtype == torch.float64 else 1e-6
    plain = {"transport_rounds": 0, "degree": 3, "refine": 1, "receive": 1}
    diffusion = {"tolerance": tolerance} | plain | diffusion
    volume = Volume(grid, density, sigma_a, sigma_s, tensor(g), emission=emission)
    settings = RenderSettings(steps_per_voxel=1), DiffusionSettings(**diffusion)
    return Scene(volume, lights, [View("view", camera)], *settings)


def march_rays(
    outgoing: OutgoingLight, rays: Rays, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Radiance and transmittance [C, R] along `rays`, a camera's or any others."""
    sight = look_along(outgoing.grid, rays, settings)
    radiance, seen = (march(outgoing, sight, settings, one) for one in (None, torch.ones(())))
    return radiance, seen - radiance


def make_operator(grid: Grid, diffusion: Tensor, absorption: Tensor) -> Operator:
    z, y, x = (conductance(diffusion, grid, axis) for axis in AXES)
    loss = absorption + boundary_loss(diffusion, grid)
    return Operator((z, y, x), loss, grid.periodic, grid.spacing)


def solve_by_gradients(operator: Operator, source: Tensor, tolerance: float) -> tuple[Tensor, int]:
    """u of `operator` u = `source` of one color, by conjugate gradients alone; and iterations."""
    scale, iteration = operator.diagonal.rsqrt(), 0
    y, residual, direction = torch.zeros_like(source), scale * source, scale * source
    goal, square = tolerance * float(residual.norm()), (residual**2).sum()
    while float(square.sqrt()) > goal:
        product = scale * operator.apply(scale * direction)
        step = square / (direction * product).sum()
        y, residual = y + step * direction, residual - step * product
        previous, square, iteration = square, (residual**2).sum(), iteration + 1
        direction = residual + square / previous * direction
    return scale * y, iteration


def dense_matrix(operator: Operator) -> Tensor:
    """The matrix `[C, n, n]` of `operator`, with loops and flat indices: a slow twin."""
    colors, *shape = operator.loss.shape
    strides = (shape[1] * shape[2], shape[2], 1)
    matrix = torch.zeros(colors, math.prod(shape), math.prod(shape), dtype=operator.loss.dtype)
    for cell in range(math.prod(shape)):
        place = [cell // strides[0], cell // strides[1] % shape[1], cell % shape[2]]
        matrix[:, cell, cell] += operator.loss[:, place[0], place[1], place[2]]
        for axis in range(3):
            is_last = place[axis] + 1 == shape[axis]
            conductance = operator.conductances[axis][:, place[0], place[1], place[2]]
            neighbor = cell + strides[axis] * (1 - shape[axis] * is_last)
            matrix[:, cell, cell] += conductance
            matrix[:, neighbor, neighbor] += conductance
            matrix[:, cell, neighbor] -= conductance
            matrix[:, neighbor, cell] -= conductance
    return matrix


def convergence_order(steps: list[float], errors: list[float]) -> float:
    """The slope of log error against log step: the order of convergence."""
    x = torch.tensor(steps, dtype=torch.float64).log()
    y = torch.tensor(errors, dtype=torch.float64).log()
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def assert_derivatives(
    total: Callable[[dict[str, Tensor]], Tensor], values: dict[str, Tensor], error: float = 1e-5
) -> None:
    """Asserts that tangent, adjoint and differences of `total` agree, along a way in all `values`.

    Each of them changes it alike: none can hide behind the others.
    """
    leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
    bars, ways = torch.autograd.grad(total(leaves), [*leaves.values()]), {}
    for seed, (name, bar) in enumerate(zip(values, bars, strict=True)):
        way = random_values(*bar.shape, seed=seed) * bar.sign()
        ways[name] = way / (bar * way).sum()
    with forward_ad.dual_level():
        duals = {n: forward_ad.make_dual(value.detach(), ways[n]) for n, value in values.items()}
        tangent = float(forward_ad.unpack_dual(total(duals)).tangent)
    assert abs(tangent / len(values) - 1) < 1e-9
    with torch.no_grad():
        up, down = (
            total({name: value + step * ways[name] for name, value in values.items()})
            for step in (1e-5, -1e-5)
        )
    assert abs(float(up - down) / 2e-5 / len(values) - 1) < error


def assert_image_derivatives(scene: Scene, names: Sequence[str], error: float = 1e-5) -> None:
    """As `assert_derivatives`, of a random sum over the images of `scene`, by its variables."""

    def total(values: dict[str, Tensor]) -> Tensor:
        image = render(with_values(scene, values))
        return (image * random_values(*image.shape, seed=1)).sum()

    assert_derivatives(total, {name: value_of(scene, name) for name in names}, error)


def count_kept(function: Callable[[], Tensor], least: int) -> int:
    """How many tensors of `least` numbers or more `function` keeps for its backward pass."""
    kept = dict[int, Tensor]()

    def note(tensor: Tensor) -> Tensor:
        if tensor.numel() >= least:
            kept[tensor.data_ptr()] = tensor.detach()
        return tensor

    with saved_tensors_hooks(note, lambda tensor: tensor):
        assert function().requires_grad
    return len(kept)


def data_matrix(
    scene: Scene, values: Mapping[str, Tensor], weights: Mapping[str, Tensor]
) -> Tensor:
    """J^T W J of all pictures (E11.1), column by column; `values` lie one after another."""
    sizes, columns = [value.numel() for value in values.values()], list[Tensor]()
    weight = torch.cat([weights[view.name].flatten() for view in scene.views])
    for way in torch.eye(sum(sizes), dtype=weight.dtype):
        ways = zip(values.items(), way.split(sizes), strict=True)
        with torch.no_grad(), forward_ad.dual_level():
            duals = {n: forward_ad.make_dual(v, d.view(v.shape)) for (n, v), d in ways}
            columns.append(forward_ad.unpack_dual(render(with_values(scene, duals))).tangent)
    jacobian = torch.stack([column.flatten() for column in columns], 1)
    return jacobian.T @ (weight[:, None] * jacobian)


def summed_series(seen: SeenPhase, depth: Tensor, cosine: Tensor) -> Tensor:
    """S(x, w) of E8.7, [C, ...], term by term, at `depth` x [C or 1, ...] and `cosine`."""
    if has_cells := seen.phase.cells is not None:
        depth, cosine = depth[..., None], cosine[..., None]
    weights = peaked_series(seen.phase, seen.degree, depth[..., None])
    total = (weights * legendre(cosine, weights.shape[-1])).sum(-1).clamp(min=0)
    return total[..., 0] if has_cells else total
