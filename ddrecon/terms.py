"""What `check` says of a scene: the physics it needs, and what can hardly be meant in it."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.defaults import FINER
from ddrecon.light.ground import stay_above
from ddrecon.light.lights import (
    BRIGHTNESS,
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
)
from ddrecon.light.sky import count_suns, decompose_lights
from ddrecon.light_field import multiply_scatters
from ddrecon.lighting import fluence
from ddrecon.march.samplers import greatest_depth
from ddrecon.medium.coefficients import (
    Medium,
    Volume,
    backward_fraction,
    has_backward_peak,
    scale_medium,
    volume_at_level,
)
from ddrecon.medium.optics import transmitted_moments
from ddrecon.numerics.sphere import count_harmonics
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings
from ddrecon.transport.sweep import count_directions
from ddrecon.variables.values import extinction_of, with_values

LIGHTS = {
    DirectionalLight: "directional light",
    PointLight: "point light",
    BeamLight: "beam from outside",
}
METHODS = {
    ("p1", "conservative"): "{} closure, multigrid",
    ("p1", "printed"): "smooth closure, printed scheme by Jacobi iteration",
    ("flux_limited", "conservative"): "damped Picard iteration with multigrid",
}
"""How diffusion is solved, by model and scheme; the closure is named where one is chosen."""
PART = 8
"""Cells along each side of the part of a volume that tells what thick cells cost."""
THICKEST, THINNEST = 3e3, 1e-3
"""Optical depths beyond these look like a wall, or like nothing."""
THICK_FACES, ABSORBING, FINEST = 2.0, 2.5, 100.0
"""A cell at a face of extinction k, the forward peak left out, and absorption a is too thick where
k + 2.5 sqrt(a k), times its size, is beyond 2: images are off by a fifth (docs/reliability.md).
Nobody takes cells 100 times smaller."""
FORWARD = 0.5
"""From this mean cosine on g may be traded for fewer scatterings."""
SMALLEST = 2.0
"""A box of fewer pixels than this, along its diagonal, shows nothing."""
UPRIGHT = 0.7
"""A camera whose right is so much along the way up lies on its side."""
UNITS = "are volume.bounds, cross sections and cameras in the same unit?"


def needed_terms(scene: Scene) -> Iterator[str]:
    """One line per term that rendering `scene` computes, in the order it is computed."""
    volume, medium = scene.volume, scale_medium(scene.volume, scene.diffusion.angles)
    is_diffuse = multiply_scatters(medium, scene.diffusion)
    yield _color_term(scene)
    means = _listed(volume.phase.moments(2)[:, 1], volume.phase.cells is not None)
    yield f"phase function {volume.phase.NAME}, mean cosine {means}"
    if volume.grid.periodic:
        axes = " and ".join("zyx"[axis] for axis in reversed(volume.grid.periodic))
        yield f"the volume repeats without end along {axes}"
    yield from _light_terms(scene)
    if volume.emission is not None or volume.black_body is not None:
        emission = "emission" if volume.black_body is None else "emission of a black body"
        yield f"{emission}, {'scattered and seen' if is_diffuse else 'only seen: not scattered'}"
    if volume.index != 1:
        inside = 1 - transmitted_moments(volume.index)[0]
        yield f"refractive index {volume.index:g}: faces reflect {inside:.1%} of light inside"
    if is_diffuse:
        yield from _diffuse_terms(medium, scene)
    else:
        yield "no multiple scattering: no diffusion solve"
    depth = greatest_depth(volume) / scene.diffusion.times
    samples = _count(scene.render.steps, "sample")
    thickest = f" of at most {depth:.3g} optical depths" if depth > 0 else ""
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


def _light_terms(scene: Scene) -> Iterator[str]:
    for kind, name in LIGHTS.items():
        if count := sum(isinstance(light, kind) for light in scene.lights):
            yield f"transmittance towards {_count(count, name)}"
    for light in scene.lights:
        if isinstance(light, EnvironmentLight):
            (height, width), (suns, directions) = light.radiance.shape[1:], count_suns(light)
            beams = f"{_count(suns, 'sun')} as beam{'s' if suns > 1 else ''}, " if suns else ""
            yield f"environment map {width} x {height}: {beams}{_count(directions, 'direction')}"
    if any(isinstance(light, AmbientLight) for light in scene.lights):
        yield "ambient light"
    if scene.ground is not None:
        plane, albedo = scene.ground.plane, _listed(scene.ground.mean_albedo, is_by_cell=False)
        yield f"ground at {'zyx'[plane.axis]} = {plane.height:g}, albedo {albedo}"


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
    directions = count_directions(settings.angles, settings.rounds)
    yield f"{rounds} of sweeps along {directions} directions, each with a diffusion solve"
    if settings.times > 1:
        finer = scene.volume.grid.refine(settings.times, settings.refine_along)
        along = "" if settings.refine_along == "xyz" else f" along {settings.refine_along}"
        cells = " x ".join(map(str, reversed(finer.shape)))
        yield f"light in {cells} cells, {settings.times} times as narrow{along}"
    if settings.halved:
        yield f"sweeps through halves of cells along {settings.halved}"
    if (settings.receive or 1) > 1:
        yield f"light of suns in {settings.receive}^3 parts of each cell"
    if scene.reason:
        yield f"by default {scene.reason}"
    sources = decompose_lights(scene.lights)
    has_beams = any(isinstance(source, DirectionalLight | BeamLight) for source in sources)
    if has_beams and has_backward_peak(medium):
        share = _listed(backward_fraction(medium), medium.is_cellwise)
        yield f"beams in pairs: a backward peak turns {share} of scattering back"


@torch.no_grad()
def thick_terms(scene: Scene) -> Iterator[str]:
    """What cells of `scene` that stay thick cost, if any do.

    That is by how much the light about the thickest changes in cells a third as wide.
    """
    volume, settings, grid = scene.volume, scene.diffusion, scene.volume.grid
    depth, size = greatest_depth(volume) / settings.times, PART // settings.times
    is_thick = depth > FINER and size > 0 and settings.rounds > 0
    if not is_thick or any(name.endswith("density") for name in scene.starts):
        return
    thickness = (extinction_of(volume).amax(0) * volume.density).expand(grid.shape)
    place = torch.unravel_index(thickness.argmax(), grid.shape)

    def around(axis: int) -> slice:
        first = max(0, min(int(place[axis]) - size // 2, grid.shape[axis] - size))
        return slice(first, min(first + size, grid.shape[axis]))

    cells = around(0), around(1), around(2)
    thickest = volume_at_level(volume, replace(grid.cut(cells), periodic=()), cells)
    light, finer = (
        fluence(replace(scene, volume=thickest, ground=None, diffusion=replace(settings, refine=n)))
        for n in (settings.times, 3 * settings.times)
    )
    weight = (extinction_of(thickest).amax(0) * thickest.density).expand_as(light)
    mean = float((weight * finer).sum() / (weight * light).sum()) - 1
    spread = float((weight * (finer - light) ** 2).sum() / (weight * light**2).sum()) ** 0.5
    yield (
        f"light in cells of at most {depth:.3g} optical depths: in thirds of the thickest it "
        f"changes by {mean:+.1%} in the mean, {spread:.1%} RMS (docs/accuracy.md#thick-cells)"
    )


def _listed(numbers: Tensor, is_by_cell: bool) -> str:
    """`numbers` of colors; or, where they differ from cell to cell, from which to which."""
    if is_by_cell:
        return f"{numbers.min().item():.3g} to {numbers.max().item():.3g} by cell"
    return ", ".join(dict.fromkeys(f"{number:.3g}" for number in numbers.flatten().tolist()))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number > 1 else ''}"


def find_doubts(scene: Scene) -> list[str]:
    """A line about each number of `scene` that can hardly be meant; parameters are at their start.

    Where the density starts as nothing, optical depths are those of a density of 1.
    """
    volume = with_values(scene, scene.starts).volume
    extinction = extinction_of(volume).amax(0)
    return [
        *_doubt_depth(volume, extinction),
        *_doubt_faces(volume, extinction, scene.diffusion),
        *_doubt_cameras(scene),
        *_doubt_ground(scene),
    ]


def _doubt_depth(volume: Volume, extinction: Tensor) -> Iterator[str]:
    density, where = volume.density, "through the densest part"
    if not bool(density.any()):
        density, where = torch.ones_like(density), "at a density of 1"
    # The thickest line of cells along each axis.
    lines = [float((extinction * density).sum(axis).max()) for axis in range(3)]
    depths = [line * size for line, size in zip(lines, volume.grid.spacing, strict=True)]
    if min(depths) > THICKEST or max(depths) < THINNEST:
        yield f"volume: the optical depth across the box is {max(depths):.3g} {where}; {UNITS}"


def _doubt_faces(volume: Volume, extinction: Tensor, settings: DiffusionSettings) -> Iterator[str]:
    """Whether a medium that scatters is thick in cells at the faces of the box.

    What counts is the depth without the forward peak, and more of it where light is absorbed.
    """
    if not bool((volume.sigma_s > 0).any()):
        return
    medium = scale_medium(volume, settings.angles)
    finer = volume.grid.refine(settings.times, settings.refine_along)
    lost = medium.extinction.value
    lost = lost + ABSORBING * (medium.absorption.value * lost).sqrt()
    thickest, depth = (
        max(
            float(field.select(axis - 3, end).max()) * size
            for axis, size in enumerate(finer.spacing)
            for end in (0, -1)
        )
        for field in (lost, extinction * volume.density)
    )
    if thickest > THICK_FACES:
        times, g = thickest / THICK_FACES, float(medium.g.max())
        advice = f"take cells {times:.1f} times smaller, and leave a layer of empty ones"
        advice = advice if times < FINEST else UNITS
        if g >= FORWARD:
            advice = f"say g: 0 and sigma_s times {1 - g:.2g} (similarity), or {advice}"
        cells = f"cells at the faces of the box are up to {depth:.3g} optical depths thick"
        yield f"volume: {cells}; images may be off by a fifth and more: {advice}"


def _doubt_cameras(scene: Scene) -> Iterator[str]:
    small, inside = list[str](), list[str]()
    for view in scene.views:
        camera, place = view.camera, view.camera.pose[:, 3].double()
        low, high = (place.new_tensor(corner) for corner in scene.volume.grid.bounds_xyz)
        distance = float(torch.dist((low + high) / 2, place)) if camera.is_perspective else 1.0
        # The diagonal of the box, seen from the side, takes hardly any pixels.
        width = 2 * float(camera.half_width) * distance
        if float(torch.dist(low, high)) * camera.size[1] < SMALLEST * width:
            small.append(view.name)
        if camera.is_perspective and bool(((low < place) & (place < high)).all()):
            inside.append(view.name)
    faults = ("the box is smaller than a pixel or two to", small), ("inside the box:", inside)
    for fault, names in faults:
        if names:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            yield f"views: {fault} camera {names[0]}{more}; {UNITS}"


def _doubt_ground(scene: Scene) -> Iterator[str]:
    """Lights that a ground hides, and cameras that lie on their side."""
    if scene.ground is None:
        return
    plane, up = scene.ground.plane, 2 - scene.ground.plane.axis
    tilted = [v.name for v in scene.views if abs(float(v.camera.pose[up, 0])) > UPRIGHT]
    if tilted:
        yield f"ground: volume.up is {'xyz'[up]}, and camera {tilted[0]} lies on its side"
    for index, light in enumerate(scene.lights):
        if not isinstance(light, EnvironmentLight) and not stay_above([light], plane):
            below = f"below the ground at {plane.height:g}"
            yield f"lights.{index}: shines from {below}, and is not seen"
