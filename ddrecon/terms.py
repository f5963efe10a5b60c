"""What physics a scene needs, in words: the same conditions the renderer composes its terms by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from ddrecon.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.medium import scaled_medium
from ddrecon.memory import Needs, gibibytes, memory_of
from ddrecon.renderer import has_flux, multiply_scatters
from ddrecon.settings import DiffusionSettings
from ddrecon.sky import count_suns
from ddrecon.variables import with_values
from ddrecon.world import Scene, View


def needed_terms(scene: Scene) -> list[str]:
    """One line per term that rendering `scene` computes, in the order it is computed."""
    medium = scaled_medium(scene.volume)
    colors = medium.extinction.scale.shape[0]
    terms = [f"{colors} color channel{'s' if colors > 1 else ' (all is gray)'}"]
    terms += _light_terms(scene.lights, multiply_scatters(medium, scene.diffusion))
    if multiply_scatters(medium, scene.diffusion) and bool(medium.g > 0):
        terms.append("delta-Eddington scaling of the forward peak (g > 0)")
    if multiply_scatters(medium, scene.diffusion):
        terms.append(f"multiple scattering by {scene.diffusion.model} diffusion, {_how(scene.diffusion)}")
        if scene.diffusion.transport_rounds:
            rounds = _counted(scene.diffusion.transport_rounds, "transport round")
            terms.append(f"{rounds} of sweeps along {scene.diffusion.transport_directions} directions, each with a diffusion solve")
        terms.append("fluxes Q1 and L1 (g is not 0)" if has_flux(medium) else "no fluxes Q1 and L1 (g = 0)")
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
    way = "as inflow of the diffusion through the box's faces" if is_diffuse else "by quadrature over 50 directions"
    if any(isinstance(light, AmbientLight) for light in lights):
        terms.append(f"ambient light, {way}")
    return terms + [_environment_term(light, way) for light in lights if isinstance(light, EnvironmentLight)]


def _environment_term(light: EnvironmentLight, way: str) -> str:
    (height, width), (suns, directions) = light.radiance.shape[1:], count_suns(light)
    as_beams = f"{_counted(suns, 'sun')} as beam{'s' if suns > 1 else ''}, " if suns else ""
    return f"environment map {width} x {height}: {as_beams}sky by {_counted(directions, 'direction')}, its mean {way}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count > 1 else ''}"


def memory_estimate(scene: Scene) -> int:
    """Bytes that rendering all views of `scene` takes at its peak, with derivatives where it is to be optimized, without torch itself."""
    volume, grid = scene.volume, scene.volume.grid
    fields = [start for start in scene.starts.values() if tuple(start.shape[-3:]) == grid.shape]
    needs = Needs(
        (grid.shape[2], grid.shape[1], grid.shape[0]),
        max(volume.sigma_a.shape[0], volume.sigma_s.shape[0]),
        torch.finfo(volume.density.dtype).bits // 8,
        sum(view.camera.size[0] * view.camera.size[1] for view in scene.views),
        has_flux=bool(volume.g != 0) or "g" in scene.starts,
        has_rounds=scene.diffusion.transport_rounds > 0,
        is_limited=scene.diffusion.model == "flux_limited",
        varied=None if scene.optimize is None else sum(field.numel() for field in fields) / grid.cells,
    )
    return memory_of(needs)


def describe(scene: Scene) -> dict[str, Any]:
    """What `ddrecon check` reports of `scene`: grid, views, physics and memory, where what it optimizes starts."""
    scene = with_values(scene, scene.starts)
    grid = scene.volume.grid
    low, high = grid.bounds_xyz
    return {
        "resolution": list(reversed(grid.shape)),
        "bounds": [list(low), list(high)],
        "voxel": list(reversed(grid.spacing)),
        "views": [_describe_view(view) for view in scene.views],
        "physics": needed_terms(scene),
        "optimizes": {name: scene.starts[name].numel() for name in scene.optimize.parameters} if scene.optimize else {},
        "memory_bytes": memory_estimate(scene),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """The report of `describe` as lines of text."""
    low, high = report["bounds"]
    views = [
        f"  {v['name']}: {v['camera']}, {v['width']} x {v['height']} pixels, {v['split']}{', with image' * v['has_image']}"
        for v in report["views"]
    ]
    return [
        f"grid: {_by(report['resolution'])} cells of {_by(report['voxel'])} u, from {low} to {high}",
        f"views: {len(views)}",
        *views,
        "physics:",
        *(f"  {term}" for term in report["physics"]),
        f"optimizes: {', '.join(_counted_entries(*item) for item in report['optimizes'].items()) or 'nothing'}",
        f"memory: about {gibibytes(report['memory_bytes'])} at the peak, besides torch itself",
    ]


def _counted_entries(name: str, count: int) -> str:
    return f"{name} ({count:,} number{'s' if count > 1 else ''})"


def _by(sizes: list[float]) -> str:
    return " x ".join(f"{size:.4g}" for size in sizes)


def _describe_view(view: View) -> dict[str, Any]:
    height, width = view.camera.size
    return {
        "name": view.name,
        "camera": "perspective" if view.camera.is_perspective else "orthographic",
        "width": width,
        "height": height,
        "split": "test" if view.is_test else "train",
        "has_image": view.image is not None,
    }
