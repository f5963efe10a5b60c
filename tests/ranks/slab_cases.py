"""What three ranks find in slabs, beside what each finds alone.

    python slab_cases.py FILE

FILE gets, by engine, by case and by what was compared, the largest difference over the largest
value. What slabs find by fused kernels, torch's operations find alone.
"""

import fcntl
import json
import os
import socket
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
import torch._dynamo  # once, before there are several: forward mode needs it
from media import box_grid, half_empty, make_camera, make_operator, make_scene, random_values
from torch import Tensor
from torch.autograd import forward_ad
from zero_tangents import ask_python

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.operator import AXES, Operator
from ddrecon.diffusion.solvers.hierarchy import Level
from ddrecon.diffusion.solvers.multigrid import multigrid
from ddrecon.diffusion.solvers.scaled import ScaledMatrix
from ddrecon.engine import current_engine, use_engine
from ddrecon.light.lights import EnvironmentLight, PointLight
from ddrecon.light.pairs import turn_in_cells
from ddrecon.ranks import alone, join_ranks, own_rank, sum_over_ranks
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.renderer import render_each
from ddrecon.scene import Scene, View
from ddrecon.slabs.exchange import add_halo, gather_slabs, sum_before, sum_slabs, swap_layers
from ddrecon.slabs.ghosts import Ghosts
from ddrecon.slabs.slab import Slab, own_slab
from ddrecon.variables.values import value_of, with_values

DIRECTION = "lights.0.direction"
RANKS, TELLS = 3, 1
"""How many there are, and which one's errors are told: it has neighbors on both sides."""
SHAPES = {"z": (21, 4, 5), "y": (5, 22, 4), "x": (4, 5, 23)}
"""Grids that are cut along each axis, into slabs of different sizes."""
ACROSS, ALONG, ASKEW = (0.2, 0.3, 2.5), (0.2, 2.5, 0.3), (1.5, 1.2, -1.6)
"""Where cameras are: how they look at a grid cut along y."""
Found = Iterator[tuple[str, Tensor, Tensor]]
"""What is compared, what was found, and what is right."""


def slab_of(axis: str) -> Slab:
    slab = own_slab(box_grid(SHAPES[axis]))
    assert isinstance(slab, Slab)
    return slab


def exchange(axis: str) -> Found:
    """Exchanges are linear, have the right values, and adjoints that are their transposes."""
    slab = slab_of(axis)
    whole = random_values(2, *SHAPES[axis])
    own = random_values(*slab.own(slab.cut(whole)).shape, seed=own_rank())
    yield "halo", add_halo(slab.own(slab.cut(whole)).clone(), slab), slab.cut(whole)
    yield "all", gather_slabs(slab.cut(whole), slab), whole
    exchanges: dict[str, Callable[[Tensor], Tensor]] = {
        "add_halo": lambda x: add_halo(x, slab),
        "gather_slabs": lambda x: gather_slabs(add_halo(x, slab), slab),
        "sum_before": lambda x: sum_before(x.flatten(1)[:, :19], torch.arange(19) % 3 > 0),
        "sum_slabs": lambda x: sum_slabs(x[:, :3, :3, :3]),
        "swap_layers": lambda x: torch.stack(swap_layers(x[:, :3, :3, :3], x[:, 1:4, 1:4, 1:4])),
    }
    for name, apply in exchanges.items():
        x = own.clone().requires_grad_()
        y = apply(x)
        y_bar = random_values(*y.shape, seed=10 + own_rank())
        (x_bar,) = torch.autograd.grad(y, x, y_bar)
        products = torch.stack([(y_bar * y).sum().detach(), (x_bar * own).sum()])
        both = sum_over_ranks([products])[0]
        yield f"transpose of {name}", both[1], both[0]
        with forward_ad.dual_level():
            tangent = forward_ad.unpack_dual(apply(forward_ad.make_dual(own, 2 * own))).tangent
        yield f"tangent of {name}", tangent, 2 * y.detach()


def cut_system(slab: Slab) -> tuple[Operator, Operator, Callable[..., Tensor]]:
    """A matrix in slabs and whole, and what cuts cells from the whole's."""
    grid, ghosts = slab.whole, Ghosts.of(slab)
    whole = make_operator(grid, 0.1 + random_values(2, *grid.shape), random_values(2, *grid.shape))

    def cut(u: Tensor, missing: int = 0) -> Tensor:
        begin = slab.cuts[slab.rank] - ghosts.layers[0]
        return u.narrow(ghosts.axis, begin, slab.size + sum(ghosts.layers) - missing).clone()

    z, y, x = (
        cut(c, missing=int(a == ghosts.axis)) for a, c in zip(AXES, whole.conductances, strict=True)
    )
    return Operator((z, y, x), cut(whole.loss), ghosts=ghosts), whole, cut


def system(axis: str) -> Found:
    """The matrix in slabs is that of the whole; a cycle of multigrid is symmetric in it."""
    slab = slab_of(axis)
    shared, whole, cut = cut_system(slab)
    a, b = (random_values(2, *SHAPES[axis], seed=seed) - 0.5 for seed in (1, 2))
    matrix, right = ScaledMatrix.of(shared), ScaledMatrix.of(whole)
    yield "product", matrix.apply(cut(a)), cut(right.apply(a))
    yield "inner", matrix.inner(cut(a), cut(b)), right.inner(a, b)
    level = Level.of(shared)
    one, other = level.cycle(cut(a)), level.cycle(cut(b))
    yield "symmetric", matrix.inner(one, cut(b)), matrix.inner(cut(a), other)
    yield "cycle", one, cut(Level.of(whole).cycle(a))


def solve(axis: str) -> Found:
    """Iterates are those of one process, from nothing and from a guess, of colors that differ."""
    wide = box_grid(tuple(max(10, cells) for cells in SHAPES[axis]))
    slab = own_slab(wide)
    assert isinstance(slab, Slab)
    shared, whole, cut = cut_system(slab)
    source, guess = (random_values(2, *wide.shape, seed=seed) for seed in (1, 2))
    source[1, 1:, 2:] = 0
    engine = current_engine()
    for name, start in (("from nothing", None), ("from a guess", guess / 10)):
        use_engine("torch")
        with alone():
            right = multigrid(whole, source, start, 1e-3)
        use_engine(engine)
        found = multigrid(shared, cut(source), None if start is None else cut(start), 1e-3)
        yield name, found.value, cut(right.value)
        yield f"iterations {name}", *(torch.tensor(1.0 * s.iterations) for s in (found, right))


def run(scene: Scene, cameras: list[Any], *more: str, has_tangents: bool = False) -> Found:
    """Pictures, what a loss of them has as derivatives, and tangents are those of one process."""
    scene.views = [View(f"v{i}", camera) for i, camera in enumerate(cameras)]
    names = ["density", "sigma_s", "lights.0.irradiance", *more]
    weights = {v.name: random_values(3, *v.camera.size, seed=3) for v in scene.views}

    def find() -> dict[str, Tensor]:
        values = {name: value_of(scene, name).detach().requires_grad_() for name in names}
        found = differentiate(scene, list(weights), values, loss_of, SolveMemory())
        if not has_tangents:
            return {"loss": found.loss, **found.gradients}
        with torch.no_grad(), forward_ad.dual_level():
            dual = {
                name: forward_ad.make_dual(value.detach(), random_values(*value.shape, seed=4))
                for name, value in values.items()
            }
            moved = with_values(scene, dual)
            pictures = render_each(moved, moved.views, SolveMemory())
            both = map(forward_ad.unpack_dual, pictures)
            each = dict(zip(weights, (torch.stack([*pair]) for pair in both), strict=True))
        return {"loss": found.loss, **found.gradients, **each}

    def loss_of(view: View, image: Tensor) -> Tensor:
        return (weights[view.name] * image).sum() + image.square().sum()

    is_told, engine = own_rank() == TELLS, current_engine()
    use_engine("torch")
    with alone():
        right = find() if is_told else {}
    use_engine(engine)
    found = find()
    for name, value in right.items():
        yield name, found[name], value


def scene_of(axis: str, **settings: Any) -> Scene:
    # Both solve by the same steps: how closely does not matter.
    return make_scene(2 * half_empty(*SHAPES[axis]), tolerance=1e-4, **settings)


def seen_from(axis: str, *eyes: tuple[float, float, float], **settings: Any) -> Found:
    scene = scene_of(axis, ambient=(0.2, 0.3, 0.4), **settings)
    names = ["lights.1.radiance", "views.v0.camera"] if len(eyes) > 1 else []
    return run(scene, [make_camera(eye) for eye in eyes], *names, has_tangents=len(eyes) > 1)


def forward_peak() -> Found:
    scene = scene_of("y", g=0.4, travel=(1.0, 3.0, 0.5))
    return run(scene, [make_camera((2.0, -1.5, 1.0))], "g", DIRECTION)


def all_per_cell(**settings: Any) -> Found:
    sigma_s = 5 + 5 * random_values(3, *SHAPES["z"], seed=5)
    scene = scene_of("z", g=0.3, sigma_s=sigma_s, **settings)
    scene.volume.g = 0.5 * random_values(*SHAPES["z"], seed=6)
    return run(scene, [make_camera((2.5, 0.4, 0.6), is_perspective=False)], "g")


def rounds(axis: str, g: float, count: int, degree: int, has_tangents: bool = False) -> Found:
    """Rounds of transport, whose light goes from slab to slab."""
    settings: dict[str, Any] = {"g": g, "transport_rounds": count, "degree": degree}
    scene = scene_of(axis, ambient=(0.2, 0.3, 0.4), **settings)
    return run(scene, [make_camera(ACROSS)], "g", "lights.1.radiance", has_tangents=has_tangents)


def pairs() -> Found:
    """Beams that backward peaks turn, of each cell its own."""
    slab, direction = slab_of("y"), torch.tensor([0.2, 0.9, -0.3], dtype=torch.float64)
    extinction = 5 * random_values(1, *SHAPES["y"], seed=7)
    turned = 0.6 * extinction * random_values(1, *SHAPES["y"], seed=8)
    right = turn_in_cells(extinction, turned, slab.whole, direction / direction.norm())
    found = turn_in_cells(
        slab.cut(extinction), slab.cut(turned), slab, direction / direction.norm()
    )
    for name, one, other in zip(("along", "against"), found, right, strict=True):
        yield name, one, slab.cut(other)


def point_light() -> Found:
    scene = scene_of("x")
    tensor = scene.volume.density.new_tensor
    scene.lights.append(PointLight(tensor([0.1, 0.9, 0.2]), tensor([1.0])))
    return run(scene, [make_camera()], "lights.1.position")


def environment() -> Found:
    scene = scene_of("y", g=0.3)
    one = torch.ones((), dtype=torch.float64)
    scene.lights.append(EnvironmentLight(random_values(3, 4, 8), one, 20 * one, 6))
    return run(scene, [make_camera()])


def lattice() -> Found:
    """Pixels close together, of which few have rays of their own."""
    scene = make_scene(1 + half_empty(*SHAPES["y"]), tolerance=1e-4)
    return run(scene, [make_camera((1.2, 0.4, 2.5), (40, 40), is_perspective=False)])


def inside() -> Found:
    """A camera in the box: rays at equal steps, which begin anew in each slab."""
    density = torch.ones(SHAPES["y"], dtype=torch.float64)
    # Where nothing scatters, and density is the same, steps of any length are exact.
    scene = make_scene(density, sigma_s=(0.0,), ambient=(1.0,), directional=None)
    scene.views = [View("v", make_camera((0.1, 0.2, 0.1)))]
    with alone():
        (right,) = render_each(scene, scene.views, SolveMemory())
    (found,) = render_each(scene, scene.views, SolveMemory())
    yield "image", found, right


CASES: dict[str, Callable[[], Found]] = {
    **{f"exchange along {axis}": partial(exchange, axis) for axis in SHAPES},
    **{f"system along {axis}": partial(system, axis) for axis in SHAPES},
    "solve along y": partial(solve, "y"),
    "light along y": partial(seen_from, "y", ACROSS, ALONG, ASKEW),
    "forward peak": forward_peak,
    "all per cell": all_per_cell,
    "rounds along z": partial(rounds, "z", 0.4, 1, 3),
    "rounds along y": partial(rounds, "y", 0.3, 1, 1, has_tangents=True),
    "rounds along x": partial(rounds, "x", 0.0, 1, 1),
    "rounds, all per cell": partial(all_per_cell, transport_rounds=1, degree=1),
    "pairs": pairs,
    "point light": point_light,
    "environment": environment,
    "lattice": lattice,
    "inside": inside,
    "smooth closure": partial(seen_from, "x", ALONG, closure="smooth"),
    "conjugate gradients": partial(seen_from, "x", ACROSS, solver="conjugate_gradient"),
    "without diffusion": partial(seen_from, "z", ACROSS, model="none"),
}


FUSED = ["all per cell", "lattice", "inside", "rounds along z"]
CASES_OF = {"torch": list(CASES), "warp": FUSED if find_spec("warp") else []}
"""Cases by engine: fused kernels are tried where slabs have some."""


def compare(engine: str) -> dict[str, dict[str, float]]:
    use_engine(engine)
    return {
        name: {
            what: float((found - right).abs().max() / right.abs().max())
            for what, found, right in CASES[name]()
        }
        for name in CASES_OF[engine]
    }


def compile_once(lock: Path) -> None:
    """Has one rank compile each kernel, while the others wait."""
    import warp

    from ddrecon.kernels import launch

    warp.config.optimization_level = 0
    load = launch.load

    def load_by_turns(*kernel: Any) -> None:
        with lock.open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            load(*kernel)

    launch.load = load_by_turns


def main(file: Path) -> None:
    torch.set_num_threads(1)
    ask_python(everything=False)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    children = []
    for rank in range(RANKS):
        child = os.fork()
        if child == 0:
            os.environ |= {
                "RANK": str(rank),
                "WORLD_SIZE": str(RANKS),
                "MASTER_ADDR": "127.0.0.1",
                "MASTER_PORT": str(port),
            }
            join_ranks(has_gpu=False, has_slabs=True)
            if CASES_OF["warp"]:
                compile_once(file.with_suffix(".lock"))
            errors = {engine: compare(engine) for engine in CASES_OF}
            if rank == TELLS:
                file.write_text(json.dumps(errors))
            os._exit(0)
        children.append(child)
    codes = [os.waitpid(child, 0)[1] for child in children]
    sys.exit(1 if any(codes) else 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
