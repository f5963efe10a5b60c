"""The fast march against its plain twin: the same integral, on other nodes, by other sums.

Both are of second order in the length of a step, so what they differ by is too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import convergence_order, make_camera, make_scene, march_rays, random_values
from torch import Tensor

from ddrecon.cameras import Rays, cast_rays
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.march.box import cross_box
from ddrecon.march.emission import Channels, Emission
from ddrecon.march.plain import march_plainly
from ddrecon.march.samplers import choose_way, make_sampler
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction
from ddrecon.medium.phase_blend import TwoLobe
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.third_order import ThirdOrder
from ddrecon.renderer import _emission, solve_light
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import value_of, with_values

SHAPE = (5, 4, 6)
STEPS = (1, 8, 64)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


LIGHTS: dict[str, list[Light]] = {
    "two beams": [
        DirectionalLight(tensor(-2, -2, -1), tensor(3, 2, 1)),
        DirectionalLight(tensor(1, 0.3, -0.5), tensor(1)),
    ],
    "a point outside": [PointLight(tensor(0.9, 0.8, -0.7), tensor(2))],
    "a point inside": [PointLight(tensor(0.1, 0.2, -0.1), tensor(2, 1, 3))],
    "a beam and ambient light": [
        DirectionalLight(tensor(-2, -2, -1), tensor(3)),
        AmbientLight(tensor(0.5, 0.4, 0.3)),
    ],
    "a sky": [EnvironmentLight(random_values(3, 8, 16), tensor(20)[0], tensor(1)[0], 8)],
}
VIEWS: dict[str, dict[str, Any]] = {
    "perspective": {},
    "oblique": {"eye": (1.5, 1.2, 1.8)},
    "orthographic": {"eye": (0.7, -0.4, 2.5), "half_width": 0.8, "is_perspective": False},
    "inside": {"eye": (0.1, 0.2, 0.15), "half_width": 1.0},
}
NUMBERS: dict[type, tuple[str, ...]] = {
    DirectionalLight: ("direction", "irradiance"),
    PointLight: ("position", "intensity"),
    AmbientLight: ("radiance",),
    EnvironmentLight: ("radiance", "rotation"),
}
each_light = pytest.mark.parametrize("lights", LIGHTS.values(), ids=LIGHTS.keys())
each_view = pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())


@pytest.fixture
def same_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    """Masses are interpolated linearly, and E13 is summed itself, in the fast march as well."""

    def along(seen: SeenPhase, depth: Tensor, cosine: Tensor) -> Tensor:
        return seen.at(depth.movedim(1, 0), cosine).movedim(0, 1)

    def at_angles(seen: SeenPhase, depth: Tensor | None, angle: Tensor) -> Tensor:
        if depth is None:
            return seen.value(angle.cos()).movedim(0, 1)
        return seen.at(depth.movedim(1, 0), angle.cos()).movedim(0, 1)

    monkeypatch.setattr(ThirdOrder, "bounded", lambda _, correction: 0 * correction)
    monkeypatch.setattr(SeenPhase, "along", along)
    monkeypatch.setattr(SeenPhase, "at_angles", at_angles)


def lit_scene(lights: list[Light], view: dict[str, Any], **changes: Any) -> Scene:
    """A random medium; under a sky alone nothing scatters twice: it is lit by all directions."""
    model = "none" if isinstance(lights[0], EnvironmentLight) else "p1"
    cross_sections = {"sigma_a": (0.5, 1.0, 0.2), "sigma_s": (3.0, 2.0, 1.0)}
    scene = make_scene(
        random_values(*SHAPE),
        directional=None,
        camera=make_camera(**view),
        **({"g": 0.6, "model": model} | cross_sections | changes),
    )
    return replace(scene, lights=lights)


def emit(scene: Scene) -> tuple[Emission, Rays]:
    rays = cast_rays(scene.views[0].camera)
    return _emission(solve_light(scene, SolveMemory()), rays), rays


def march_fast(emission: Emission, rays: Rays, steps: int) -> tuple[Tensor, Tensor]:
    return march_rays(emission, rays, RenderSettings(steps_per_voxel=steps, tolerance=0.0))


def march_twin(emission: Emission, rays: Rays, steps: int) -> tuple[Tensor, Tensor]:
    return march_plainly(emission, rays, 12 * steps)


def differences(of: Callable[[Callable[..., Any], int], list[Tensor]]) -> list[list[float]]:
    """How far apart the two marches are, relative to the norm, at STEPS.

    Of each of the quantities `of(marcher, steps)`.
    """
    apart = []
    for steps in STEPS:
        pairs = zip(of(march_fast, steps), of(march_twin, steps), strict=True)
        apart.append([float((fast - plain).norm() / plain.norm()) for fast, plain in pairs])
    return [list(errors) for errors in zip(*apart, strict=True)]


def assert_order(errors: list[float], finest: float, order: float = 1.7) -> None:
    assert errors[-1] < finest, errors
    assert convergence_order([1 / steps for steps in STEPS], errors) > order, errors


@each_light
@each_view
@pytest.mark.usefixtures("same_fields")
def test_images_agree_in_the_limit(lights: list[Light], view: dict[str, Any]):
    emission, rays = emit(lit_scene(lights, view))
    radiance, transmittance = differences(
        lambda marcher, steps: list(marcher(emission, rays, steps))
    )
    assert_order(radiance, 1e-3)
    assert_order(transmittance, 1e-4)


CROSS_SECTION = random_values(3, *SHAPE, seed=7)


@pytest.mark.parametrize(
    "changes",
    [{"g": 0.0}, {"g": -0.4}, {"sigma_s": CROSS_SECTION}, {"sigma_a": CROSS_SECTION, "g": 0.0}],
    ids=["isotropic", "backward", "scattering varies", "absorption varies"],
)
@pytest.mark.usefixtures("same_fields")
def test_images_of_other_media_agree_in_the_limit(changes: dict[str, Any]):
    emission, rays = emit(lit_scene(LIGHTS["two beams"], VIEWS["oblique"], **changes))
    for errors in differences(lambda marcher, steps: list(marcher(emission, rays, steps))):
        assert_order(errors, 1e-3)


@pytest.mark.parametrize(
    "phase",
    [
        HenyeyGreenstein(1.2 * random_values(*SHAPE, seed=8) - 0.4),
        TwoLobe(tensor(0.6, -0.3), random_values(*SHAPE, seed=9)),
    ],
    ids=["g", "weight"],
)
@pytest.mark.parametrize("light", ["two beams", "a point inside"])
@pytest.mark.usefixtures("same_fields")
def test_phase_functions_of_cells_agree_in_the_limit(phase: PhaseFunction, light: str):
    """As closely as E13 is looked up by their number."""
    scene = lit_scene(LIGHTS[light], VIEWS["oblique"])
    scene.volume.phase = phase
    emission, rays = emit(scene)
    for errors in differences(lambda marcher, steps: list(marcher(emission, rays, steps))):
        assert_order(errors, 1e-3, 1.6)


def test_they_agree_with_finer_cells_whatever_is_interpolated():
    """Masses to third order or linearly, E13 by a table or itself: in a smooth medium."""
    errors = []
    for count in (8, 16, 32):
        scene = lit_scene(LIGHTS["two beams"][:1], VIEWS["oblique"], g=0.3, model="none")
        axes = [torch.linspace(-1, 1, count + 1)[1:] - 1 / count for _ in range(3)]
        z, y, x = torch.meshgrid(*axes, indexing="ij")
        density = 2 * torch.exp(-2 * (x**2 + y**2 + z**2)).double()
        grid = replace(scene.volume.grid, shape=density.shape)
        emission, rays = emit(
            replace(scene, volume=replace(scene.volume, density=density, grid=grid))
        )
        fast, plain = march_fast(emission, rays, 4)[0], march_twin(emission, rays, 16)[0]
        errors.append(float((fast - plain).norm() / plain.norm()))
    assert errors[-1] < 2e-3 and convergence_order([1 / 8, 1 / 16, 1 / 32], errors) > 1.5, errors


def test_where_both_sample_alike_transmittance_is_the_same():
    """At equal steps both take the depth by trapezoids."""
    emission, rays = emit(lit_scene(LIGHTS["two beams"], VIEWS["inside"]))
    crossing = cross_box(emission.grid, rays)
    channels = Channels([emission.extinction.field])
    way = choose_way(emission.grid, rays, crossing)
    count = make_sampler(channels, emission.grid, way, 1).nodes - 1
    torch.testing.assert_close(
        march_fast(emission, rays, 1)[1],
        march_plainly(emission, rays, count)[1],
        rtol=1e-12,
        atol=0,
    )


@each_light
@pytest.mark.parametrize("view", ["oblique", "inside"])
@pytest.mark.usefixtures("same_fields")
def test_derivatives_agree_in_the_limit(lights: list[Light], view: str):
    """By the medium, the lights and the camera.

    The camera's is of first order: a density linear between cells has kinks, which nodes step over.
    """
    scene = lit_scene(lights, VIEWS[view])
    of_lights = [
        f"lights.{index}.{number}"
        for index, light in enumerate(lights)
        for number in NUMBERS[type(light)]
    ]
    names = ["density", "g", "sigma_s", *of_lights, "views.view.camera"]
    leaves = {name: value_of(scene, name).detach().clone().requires_grad_() for name in names}
    emission, rays = emit(with_values(scene, leaves))
    weights = random_values(2, 3, len(rays.direction), seed=5)

    def gradients(marcher: Callable[..., Any], steps: int) -> list[Tensor]:
        loss = (weights * torch.stack(marcher(emission, rays, steps))).sum()
        return list(torch.autograd.grad(loss, list(leaves.values()), retain_graph=True))

    for name, errors in zip(names, differences(gradients), strict=True):
        is_camera = name == "views.view.camera"
        assert_order(errors, *((0.01, 0.7) if is_camera else (1e-3, 1.5)))
