"""What physics a scene needs, in words: the same conditions the renderer composes its terms by."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ddrecon.diffusion.rounds.sweep import DIRECTIONS
from ddrecon.engine import engine_of_parts, has_kernels
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.light.sky import count_suns
from ddrecon.march.steps import greatest_depth
from ddrecon.medium.coefficients import Medium, scale_medium
from ddrecon.medium.phase import PhaseFunction
from ddrecon.medium.remaining import backward_fraction, has_backward_peak, remaining_moments
from ddrecon.numerics.harmonics import count_harmonics
from ddrecon.renderer import multiply_scatters
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings


def needed_terms(scene: Scene) -> list[str]:
    """One line per term that rendering `scene` computes, in the order it is computed."""
    samples = _count(scene.render.steps, "sample")
    depth = f"{greatest_depth(scene.volume):.2g}"
    return [*_light_in(scene), f"view rays: {samples} a cell of at most {depth} optical depths"]


def engine_of_scene(scene: Scene, has_slabs: bool) -> dict[str, str]:
    """The engine that runs each part of rendering `scene`."""
    return engine_of_parts(parts_in_torch(scene, has_slabs, scene.volume.density.is_cuda))


def parts_in_torch(scene: Scene, has_slabs: bool, is_on_gpu: bool) -> tuple[str, ...]:
    """The parts that are torch's with every engine, for what `scene` asks of them.

    `has_slabs`: ranks share out its cells. Of point lights that is all but the mass on the way to
    them; of phase functions by cell, what light and rounds are at cells: view rays look them up.
    """
    settings, medium = scene.diffusion, scale_medium(scene.volume, scene.diffusion.angles)
    is_fused = settings.model != "flux_limited" and settings.scheme == "conservative"
    is_fused = is_fused and settings.solver == "multigrid" and has_kernels("diffusion", is_on_gpu)
    has_skies = any(isinstance(light, AmbientLight | EnvironmentLight) for light in scene.lights)
    is_diffuse, has_rounds = multiply_scatters(medium, settings), settings.rounds > 0
    parts = {
        "diffusion": not is_fused or (has_slabs and is_diffuse),
        "transport rounds": has_rounds
        and not has_kernels("transport rounds", is_on_gpu, has_slabs),
        "beams": has_slabs and (has_skies or _has_beams(scene.lights)),
        "point lights": any(isinstance(light, PointLight) for light in scene.lights),
        "pairs of beams": is_diffuse and _has_pairs(medium, scene),
        "phases by cell": medium.is_cellwise,
        "skies towards cameras": has_skies and medium.is_anisotropic and not is_diffuse,
    }
    return tuple(part for part, is_in_torch in parts.items() if is_in_torch)


def _light_in(scene: Scene) -> list[str]:
    """The terms of the light in the volume of `scene`."""
    settings = scene.diffusion
    medium = scale_medium(scene.volume, settings.angles)
    colors = medium.extinction.scale.shape[0]
    is_diffuse = multiply_scatters(medium, settings)
    terms = [f"{colors} color channel{'s' if colors > 1 else ' (all is gray)'}"]
    terms.append(_phase_term(scene.volume.phase))
    terms += _light_terms(scene.lights, is_diffuse)
    if not is_diffuse:
        return [*terms, "no multiple scattering: no diffusion solve"]
    if bool((medium.forward_fraction > 0).any()):
        terms.append(_peak_term(medium))
    terms.append(f"multiple scattering by {settings.model} diffusion, {_method(settings)}")
    if settings.rounds:
        terms += _round_terms(medium, scene)
    else:
        terms.append("no transport rounds: diffusion alone")
    return [*terms, _angle_term(medium)]


def _round_terms(medium: Medium, scene: Scene) -> list[str]:
    """Transport rounds, and the pairs of beams that they go with."""
    settings = scene.diffusion
    rounds = _count(settings.rounds, "transport round")
    directions = DIRECTIONS[settings.angles]
    terms = [f"{rounds} of sweeps along {directions} directions, each with a diffusion solve"]
    if medium.degree > 1:
        left = remaining_moments(medium)[2].abs().max().item()
        terms[0] += f"; each leaves up to {left:.2g} of what diffusion lacks"
    if _has_pairs(medium, scene):
        part = backward_fraction(medium).max().item()
        most = "up to " if medium.is_cellwise else ""
        terms.append(f"beams in pairs: a backward peak turns {most}{part:.3g} of scattering back")
    return terms


def _has_pairs(medium: Medium, scene: Scene) -> bool:
    """Whether backward peaks turn beams back and forth (E20)."""
    return has_backward_peak(medium) and _has_beams(scene.lights)


def _has_beams(lights: Sequence[Light]) -> bool:
    """Whether a light is directional, or has suns that are."""
    return any(
        isinstance(light, DirectionalLight)
        or (isinstance(light, EnvironmentLight) and count_suns(light)[0] > 0)
        for light in lights
    )


def _angle_term(medium: Medium) -> str:
    """What of light's direction is kept."""
    if medium.degree == 0:
        return "no fluxes Q1 and L1 (g = 0)"
    if medium.degree == 1:
        return "fluxes Q1 and L1 (g is not 0)"
    moments = count_harmonics(medium.degree)
    return f"angles to degree {medium.degree}: {moments} moments of light (g is not 0)"


def _phase_term(phase: PhaseFunction) -> str:
    """Which phase function, and its mean cosine."""
    means = phase.moments(2)[:, 1]
    if phase.cells is not None:
        least, most = means.min().item(), means.max().item()
        return f"phase function {phase.NAME}, mean cosine per cell, {least:.3g} to {most:.3g}"
    return f"phase function {phase.NAME}, mean cosine {_listed(means)}"


def _peak_term(medium: Medium) -> str:
    """What part of scattering counts as not scattered."""
    fraction = medium.forward_fraction
    parts = f"up to {fraction.max().item():.3g}" if medium.is_cellwise else _listed(fraction)
    return f"delta-Eddington scaling of the forward peak, {parts} of scattering"


def _listed(numbers: Tensor) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers.flatten().tolist())


def _method(settings: DiffusionSettings) -> str:
    if settings.scheme == "printed":
        return "smooth closure, printed scheme by Jacobi iteration"
    if settings.model == "flux_limited":
        return f"{settings.limiter} limiter, damped Picard iteration with {settings.solver}"
    return f"{settings.closure} closure, {settings.solver}"


def _light_terms(lights: Sequence[Light], is_diffuse: bool) -> list[str]:
    terms = []
    for kind, name in ((DirectionalLight, "directional light"), (PointLight, "point light")):
        count = sum(isinstance(light, kind) for light in lights)
        if count:
            terms.append(f"transmittance towards {_count(count, name)}")
    ambient = "by quadrature over 50 directions"
    if is_diffuse:
        ambient = "as inflow of the diffusion through the box's faces"
    if any(isinstance(light, AmbientLight) for light in lights):
        terms.append(f"ambient light, {ambient}")
    maps = [light for light in lights if isinstance(light, EnvironmentLight)]
    return terms + [_environment_term(light, ambient) for light in maps]


def _environment_term(light: EnvironmentLight, ambient: str) -> str:
    (height, width), (suns, directions) = light.radiance.shape[1:], count_suns(light)
    beams = f"{_count(suns, 'sun')} as beam{'s' if suns > 1 else ''}, " if suns else ""
    sky = f"sky by {_count(directions, 'direction')}, its mean {ambient}"
    return f"environment map {width} x {height}: {beams}{sky}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number > 1 else ''}"
