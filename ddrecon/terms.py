"""What physics a scene needs, in words: by the conditions on which light is composed."""

from __future__ import annotations

from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.ground import UPWARDS, Ground
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
from ddrecon.medium.coefficients import Medium, Volume, scale_medium
from ddrecon.medium.fresnel import transmitted_moments
from ddrecon.medium.remaining import backward_fraction, has_backward_peak
from ddrecon.numerics.harmonics import count_harmonics
from ddrecon.scene import Scene
from ddrecon.transport.sweep import count_directions


def needed_terms(scene: Scene) -> list[str]:
    """One line per term that rendering `scene` computes, in the order it is computed."""
    medium, phase = scale_medium(scene.volume, scene.diffusion.angles), scene.volume.phase
    is_diffuse = multiply_scatters(medium, scene.diffusion)
    samples = _count(scene.render.steps, "sample")
    means = _listed(phase.moments(2)[:, 1], phase.cells is not None)
    depth = greatest_depth(scene.volume) / scene.diffusion.times
    return [
        _color_term(scene),
        f"phase function {phase.NAME}, mean cosine {means}",
        *_period_terms(scene.volume.grid),
        *_light_terms(scene, is_diffuse),
        *_glow_terms(scene.volume, is_diffuse),
        *_face_terms(scene.volume.index),
        *_ground_terms(scene.ground, scene.volume.grid),
        *_diffuse_terms(medium, scene, is_diffuse),
        f"view rays: {samples} a cell of at most {depth:.2g} optical depths",
    ]


def _color_term(scene: Scene) -> str:
    """How many color channels there are, and what has as many."""
    volume, ground = scene.volume, scene.ground
    views = [v for view in scene.views for v in (view.exposure, view.offset, view.background)]
    values: dict[str, list[Tensor | None]] = {
        "the medium": [volume.sigma_a, volume.sigma_s],
        "what glows": [volume.emission, volume.black_body],
        "lights": [v for light in scene.lights for k, v in vars(light).items() if k in BRIGHTNESS],
        "the ground": [] if ground is None else [ground.albedo],
        "views": views,
    }
    colored = ["the phase function"] * (volume.phase.colors > 1)
    for name, tensors in values.items():
        # Colors are the first axis; a number without axes is a factor of all colors.
        if any(value is not None and value.ndim and len(value) > 1 for value in tensors):
            colored.append(name)
    return (
        f"3 color channels ({', '.join(colored)})" if colored else "1 color channel (all is gray)"
    )


def _face_terms(index: float) -> list[str]:
    if index == 1:
        return []
    inside, outside = 1 - transmitted_moments(index)[0], ((index - 1) / (index + 1)) ** 2
    return [
        f"refractive index {index:g}: faces reflect {inside:.1%} of diffuse light inside, "
        f"and {outside:.1%} of light from straight ahead"
    ]


def _glow_terms(volume: Volume, is_diffuse: bool) -> list[str]:
    if volume.emission is None and volume.black_body is None:
        return []
    what = "emission" if volume.black_body is None else "emission of a black body"
    return [f"{what}, {'scattered and seen' if is_diffuse else 'only seen: it is not scattered'}"]


def _period_terms(grid: Grid) -> list[str]:
    axes = " and ".join("zyx"[axis] for axis in reversed(grid.periodic))
    return [f"the volume repeats without end along {axes}"] if axes else []


def _diffuse_terms(medium: Medium, scene: Scene, is_diffuse: bool) -> list[str]:
    """The terms of light that is scattered more than once."""
    if not is_diffuse:
        return ["no multiple scattering: no diffusion solve"]
    settings, fraction = scene.diffusion, medium.forward_fraction
    methods = {
        ("p1", "conservative"): f"{settings.closure} closure, multigrid",
        ("p1", "printed"): "smooth closure, printed scheme by Jacobi iteration",
        ("flux_limited", "conservative"): "damped Picard iteration with multigrid",
    }
    method = methods[settings.model, settings.scheme]
    terms = [f"multiple scattering by {settings.model} diffusion, {method}"]
    if bool((fraction > 0).any()):
        share = _listed(fraction, medium.is_cellwise)
        terms.insert(0, f"delta-Eddington scaling of the forward peak, {share} of scattering")
    terms += _round_terms(medium, scene) or ["no transport rounds: diffusion alone"]
    moments = count_harmonics(medium.degree)
    degrees = ["no fluxes Q1 and L1 (g = 0)", "fluxes Q1 and L1 (g is not 0)"]
    degrees += [f"angles to degree {medium.degree}: {moments} moments of light (g is not 0)"]
    return [*terms, degrees[min(medium.degree, 2)]]


def _round_terms(medium: Medium, scene: Scene) -> list[str]:
    """The terms of transport rounds, none without rounds."""
    settings = scene.diffusion
    if not settings.rounds:
        return []
    rounds = _count(settings.rounds, "transport round")
    if settings.transport_tolerance is not None:
        rounds += f" at most, to a residual of {settings.transport_tolerance:g},"
    directions = count_directions(settings.angles, settings.rounds)
    terms = [f"{rounds} of sweeps along {directions} directions, each with a diffusion solve"]
    if settings.times > 1:
        finer = scene.volume.grid.refine(settings.times, settings.refine_along)
        along = "" if settings.refine_along == "xyz" else f" along {settings.refine_along}"
        terms.append(f"light in {_cells(finer)}, {settings.times} times as narrow{along}")
    if scene.reason:
        terms.append(f"by default {scene.reason}")
    if has_backward_peak(medium) and _has_beams(scene):
        share = _listed(backward_fraction(medium), medium.is_cellwise)
        terms.append(f"beams in pairs: a backward peak turns {share} of scattering back")
    return terms


def _has_beams(scene: Scene) -> bool:
    """Whether a light is directional, or has suns that are."""
    sources = decompose_lights(scene.lights)
    return any(isinstance(source, DirectionalLight | BeamLight) for source in sources)


def _light_terms(scene: Scene, is_diffuse: bool) -> list[str]:
    lights, terms = scene.lights, list[str]()
    for kind, name in ((DirectionalLight, "directional light"), (PointLight, "point light")):
        if count := sum(isinstance(light, kind) for light in lights):
            terms.append(f"transmittance towards {_count(count, name)}")
    for beam in (light for light in lights if isinstance(light, BeamLight)):
        radius = float(seen_radius(beam.radius, max(scene.volume.grid.spacing)))
        terms.append(f"transmittance towards a beam from outside, {radius:.3g} u in radius here")
    ambient = "by quadrature over 50 directions"
    if is_diffuse:
        ambient = "as inflow of the diffusion through the box's faces"
    if any(isinstance(light, AmbientLight) for light in lights):
        terms.append(f"ambient light, {ambient}")
    for sky_map in (light for light in lights if isinstance(light, EnvironmentLight)):
        (height, width), (suns, directions) = sky_map.radiance.shape[1:], count_suns(sky_map)
        beams = f"{_count(suns, 'sun')} as beam{'s' if suns > 1 else ''}, " if suns else ""
        sky = f"sky by {_count(directions, 'direction')}, its mean {ambient}"
        terms.append(f"environment map {width} x {height}: {beams}{sky}")
    return terms


def _ground_terms(ground: Ground | None, grid: Grid) -> list[str]:
    """A ground, and on what it and the volume light each other."""
    if ground is None:
        return []
    albedo = _listed(ground.mean_albedo, is_by_cell=False)
    if ground.albedo.ndim > 1:
        rows, columns = ground.albedo.shape[1:]
        albedo += f" in the mean of {columns} x {rows} pixels"
    return [
        f"ground at {'zyx'[ground.plane.axis]} = {ground.plane.height:g}, albedo {albedo}: direct "
        f"light ray by ray, other light by {DOWNWARDS} directions, its own by {UPWARDS}, "
        f"to and fro in {_cells(exchange_grid(grid))}"
    ]


def _cells(grid: Grid) -> str:
    return f"{' x '.join(map(str, reversed(grid.shape)))} cells"


def _listed(numbers: Tensor, is_by_cell: bool) -> str:
    """`numbers` of colors; or, where they differ from cell to cell, from which to which."""
    if is_by_cell:
        return f"{numbers.min().item():.3g} to {numbers.max().item():.3g} by cell"
    return ", ".join(dict.fromkeys(f"{number:.3g}" for number in numbers.flatten().tolist()))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number > 1 else ''}"
