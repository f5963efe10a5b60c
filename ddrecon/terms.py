"""What physics a scene needs, in words: by the conditions on which light is composed."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.ground import UPWARDS
from ddrecon.light.lights import (
    BRIGHTNESS,
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
)
from ddrecon.light.profile import seen_radius
from ddrecon.light.sky import count_suns, decompose_lights
from ddrecon.light_field import multiply_scatters
from ddrecon.lighting import exchange_grid
from ddrecon.march.ground import DOWNWARDS
from ddrecon.march.samplers import greatest_depth
from ddrecon.medium.coefficients import Medium, scale_medium
from ddrecon.medium.fresnel import transmitted_moments
from ddrecon.medium.remaining import backward_fraction, has_backward_peak
from ddrecon.numerics.harmonics import count_harmonics
from ddrecon.scene import Scene
from ddrecon.transport.sweep import count_directions

METHODS = {
    ("p1", "conservative"): "{} closure, multigrid",
    ("p1", "printed"): "smooth closure, printed scheme by Jacobi iteration",
    ("flux_limited", "conservative"): "damped Picard iteration with multigrid",
}
"""How diffusion is solved, by model and scheme; the closure is named where one is chosen."""


def needed_terms(scene: Scene) -> list[str]:
    """One line per term that rendering `scene` computes, in the order it is computed."""
    return list(_terms(scene))


def _terms(scene: Scene) -> Iterator[str]:
    volume, medium = scene.volume, scale_medium(scene.volume, scene.diffusion.angles)
    is_diffuse = multiply_scatters(medium, scene.diffusion)
    yield _color_term(scene)
    means = _listed(volume.phase.moments(2)[:, 1], volume.phase.cells is not None)
    yield f"phase function {volume.phase.NAME}, mean cosine {means}"
    if volume.grid.periodic:
        axes = " and ".join("zyx"[axis] for axis in reversed(volume.grid.periodic))
        yield f"the volume repeats without end along {axes}"
    yield from _light_terms(scene, is_diffuse)
    if volume.emission is not None or volume.black_body is not None:
        emission = "emission" if volume.black_body is None else "emission of a black body"
        yield f"{emission}, {'scattered and seen' if is_diffuse else 'only seen: not scattered'}"
    if volume.index != 1:
        inside = 1 - transmitted_moments(volume.index)[0]
        outside = ((volume.index - 1) / (volume.index + 1)) ** 2
        yield (
            f"refractive index {volume.index:g}: faces reflect {inside:.1%} of diffuse light "
            f"inside, and {outside:.1%} of light from straight ahead"
        )
    yield from _ground_terms(scene)
    if is_diffuse:
        yield from _diffuse_terms(medium, scene)
    else:
        yield "no multiple scattering: no diffusion solve"
    depth = greatest_depth(volume) / scene.diffusion.times
    samples = _count(scene.render.steps, "sample")
    thickest = f" of at most {depth:.2g} optical depths" if depth > 0 else ""
    yield f"view rays: {samples} a cell{thickest}"


def _color_term(scene: Scene) -> str:
    """How many color channels there are, and what has as many."""
    volume, ground = scene.volume, scene.ground
    values: dict[str, list[Tensor | None]] = {
        "the medium": [volume.sigma_a, volume.sigma_s],
        "what glows": [volume.emission, volume.black_body],
        "lights": [v for light in scene.lights for k, v in vars(light).items() if k in BRIGHTNESS],
        "the ground": [] if ground is None else [ground.albedo],
        "views": [v for view in scene.views for v in (view.exposure, view.offset, view.background)],
    }
    colored = ["the phase function"] * (volume.phase.colors > 1)
    for name, tensors in values.items():
        # Colors are the first axis; a number without axes is a factor of all colors.
        if any(value is not None and value.ndim and len(value) > 1 for value in tensors):
            colored.append(name)
    return (
        f"3 color channels ({', '.join(colored)})" if colored else "1 color channel (all is gray)"
    )


def _light_terms(scene: Scene, is_diffuse: bool) -> Iterator[str]:
    for kind, name in ((DirectionalLight, "directional light"), (PointLight, "point light")):
        if count := sum(isinstance(light, kind) for light in scene.lights):
            yield f"transmittance towards {_count(count, name)}"
    ambient = "by quadrature over 50 directions"
    if is_diffuse:
        ambient = "as inflow of the diffusion through the box's faces"
    for light in scene.lights:
        if isinstance(light, BeamLight):
            radius = float(seen_radius(light.radius, max(scene.volume.grid.spacing)))
            yield f"transmittance towards a beam from outside, {radius:.3g} u in radius here"
        elif isinstance(light, EnvironmentLight):
            (height, width), (suns, directions) = light.radiance.shape[1:], count_suns(light)
            beams = f"{_count(suns, 'sun')} as beam{'s' if suns > 1 else ''}, " if suns else ""
            sky = f"sky by {_count(directions, 'direction')}, its mean {ambient}"
            yield f"environment map {width} x {height}: {beams}{sky}"
    if any(isinstance(light, AmbientLight) for light in scene.lights):
        yield f"ambient light, {ambient}"


def _ground_terms(scene: Scene) -> Iterator[str]:
    """A ground, and on what it and the volume light each other."""
    ground = scene.ground
    if ground is None:
        return
    albedo = _listed(ground.mean_albedo, is_by_cell=False)
    if ground.albedo.ndim > 1:
        rows, columns = ground.albedo.shape[1:]
        albedo += f" in the mean of {columns} x {rows} pixels"
    yield (
        f"ground at {'zyx'[ground.plane.axis]} = {ground.plane.height:g}, albedo {albedo}: direct "
        f"light ray by ray, other light by {DOWNWARDS} directions, its own by {UPWARDS}, "
        f"to and fro in {_cells(exchange_grid(scene)[0])}"
    )


def _diffuse_terms(medium: Medium, scene: Scene) -> Iterator[str]:
    """The terms of light that is scattered more than once."""
    settings, fraction = scene.diffusion, medium.forward_fraction
    if bool((fraction > 0).any()):
        share = _listed(fraction, medium.is_cellwise)
        yield f"delta-Eddington scaling of the forward peak, {share} of scattering"
    method = METHODS[settings.model, settings.scheme].format(settings.closure)
    yield f"multiple scattering by {settings.model} diffusion, {method}"
    if settings.rounds:
        yield from _round_terms(medium, scene)
    else:
        yield "no transport rounds: diffusion alone"
    if medium.degree < 2:
        yield ("no fluxes Q1 and L1 (g = 0)", "fluxes Q1 and L1 (g is not 0)")[medium.degree]
    else:
        moments = count_harmonics(medium.degree)
        yield f"angles to degree {medium.degree}: {moments} moments of light (g is not 0)"


def _round_terms(medium: Medium, scene: Scene) -> Iterator[str]:
    settings = scene.diffusion
    rounds = _count(settings.rounds, "transport round")
    if settings.transport_tolerance is not None:
        rounds += f" at most, to a residual of {settings.transport_tolerance:g},"
    directions = count_directions(scene.volume.grid, settings.angles, settings.rounds)
    yield f"{rounds} of sweeps along {directions} directions, each with a diffusion solve"
    if settings.times > 1:
        finer = scene.volume.grid.refine(settings.times, settings.refine_along)
        along = "" if settings.refine_along == "xyz" else f" along {settings.refine_along}"
        yield f"light in {_cells(finer)}, {settings.times} times as narrow{along}"
    if (settings.receive or 1) > 1:
        yield f"light of suns in {settings.receive}^3 parts of each cell"
    if scene.reason:
        yield f"by default {scene.reason}"
    sources = decompose_lights(scene.lights)
    has_beams = any(isinstance(source, DirectionalLight | BeamLight) for source in sources)
    if has_beams and has_backward_peak(medium):
        share = _listed(backward_fraction(medium), medium.is_cellwise)
        yield f"beams in pairs: a backward peak turns {share} of scattering back"


def _cells(grid: Grid) -> str:
    return f"{' x '.join(map(str, reversed(grid.shape)))} cells"


def _listed(numbers: Tensor, is_by_cell: bool) -> str:
    """`numbers` of colors; or, where they differ from cell to cell, from which to which."""
    if is_by_cell:
        return f"{numbers.min().item():.3g} to {numbers.max().item():.3g} by cell"
    return ", ".join(dict.fromkeys(f"{number:.3g}" for number in numbers.flatten().tolist()))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number > 1 else ''}"
