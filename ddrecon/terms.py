"""What physics a scene needs, in words: the same conditions the renderer composes its terms by."""

from __future__ import annotations

from collections.abc import Sequence

from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.light.sky import count_suns
from ddrecon.medium.coefficients import scale_medium
from ddrecon.renderer import multiply_scatters
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings


def needed_terms(scene: Scene) -> list[str]:
    """One line per term that rendering `scene` computes, in the order it is computed."""
    medium = scale_medium(scene.volume)
    colors = medium.extinction.scale.shape[0]
    terms = [f"{colors} color channel{'s' if colors > 1 else ' (all is gray)'}"]
    terms += _light_terms(scene.lights, multiply_scatters(medium, scene.diffusion))
    if multiply_scatters(medium, scene.diffusion) and bool(medium.g > 0):
        terms.append("delta-Eddington scaling of the forward peak (g > 0)")
    if multiply_scatters(medium, scene.diffusion):
        terms.append(
            f"multiple scattering by {scene.diffusion.model} diffusion, {_how(scene.diffusion)}"
        )
        if scene.diffusion.transport_rounds:
            rounds = _counted(scene.diffusion.transport_rounds, "transport round")
            terms.append(
                f"{rounds} of sweeps along {scene.diffusion.transport_directions} directions, each with a diffusion solve"
            )
        terms.append(
            "fluxes Q1 and L1 (g is not 0)" if medium.has_flux else "no fluxes Q1 and L1 (g = 0)"
        )
    else:
        terms.append("no multiple scattering: no diffusion solve")
    return terms


def _how(settings: DiffusionSettings) -> str:
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
            terms.append(f"transmittance towards {_counted(count, name)}")
    way = (
        "as inflow of the diffusion through the box's faces"
        if is_diffuse
        else "by quadrature over 50 directions"
    )
    if any(isinstance(light, AmbientLight) for light in lights):
        terms.append(f"ambient light, {way}")
    return terms + [
        _environment_term(light, way) for light in lights if isinstance(light, EnvironmentLight)
    ]


def _environment_term(light: EnvironmentLight, way: str) -> str:
    (height, width), (suns, directions) = light.radiance.shape[1:], count_suns(light)
    as_beams = f"{_counted(suns, 'sun')} as beam{'s' if suns > 1 else ''}, " if suns else ""
    return f"environment map {width} x {height}: {as_beams}sky by {_counted(directions, 'direction')}, its mean {way}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count > 1 else ''}"
