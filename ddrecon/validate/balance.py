"""The energy balance of a scene: what enters its box, what is absorbed there, what leaves (E5.7).

Scattered light leaves as one more sweep has it, in which nothing is lost; what passes unscattered
is followed to the middle of each cell at a face. Both are found apart from the fluence, by which
light is absorbed: what the sum lacks says how good all three are.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain, product
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.grid import array_order
from ddrecon.light.ground import UPWARDS, hemisphere, look_up_texels, stay_above
from ddrecon.light.lights import AmbientLight, DirectionalLight, PointLight
from ddrecon.light.moments import add, cut, fill, weigh
from ddrecon.light.pairs import ReversedBeam
from ddrecon.light.profile import enter_faces
from ddrecon.light.reduced import ambient_radiance
from ddrecon.light.sky import Sky, Source, decompose_lights
from ddrecon.light_field import LightField, fluence_of, multiply_scatters
from ddrecon.lighting import solve_light
from ddrecon.march.ground import Beamed, LitGround, shine_on, transmittance
from ddrecon.medium.coefficients import Medium, remaining_moments
from ddrecon.medium.optics import reflectance, transmitted_moments
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.transport.characteristics import Characteristic, radiance_along
from ddrecon.transport.mirror import TURNS, follow_inside
from ddrecon.transport.rounds import face_mirror
from ddrecon.transport.sweep import DIRECTIONS, emitted_light, steep_gradient, sweep_rule

FACES = "-z", "+z", "-y", "+y", "-x", "+x"
"""The faces of the box, in array order."""
SWEEPS = 12
"""Sweeps of light that faces reflect inside."""
RAY_BY_RAY = RenderSettings(tolerance=0.0)


@torch.no_grad()
def find_balance(scene: Scene) -> dict[str, Any]:
    """The power that `enters` the box of `scene` by each light, is `absorbed` there, and `leaves`
    by each face.

    What a ground sends up and what the medium emits enters as well; `into_ground` is what of all
    that leaves falls on the ground. Where faces refract light, what is `reflected` by them from
    outside counts as entering, too. `fractions` are the same of all that enters; `defect_percent`
    is what enters and neither is absorbed nor leaves. Of a volume that repeats it is the balance of
    one period, whose sides nothing crosses. Powers are numbers of one color, else lists of three.
    Raises UsageError where no light enters, or where nobody follows light that is scattered.
    """
    light_field, settings = solve_light(scene, SolveMemory()), scene.diffusion
    medium, lit = light_field.medium, light_field.ground
    if is_any_nonzero(medium.scattering.scale) and not multiply_scatters(medium, settings):
        raise UsageError("diffusion.model: none follows no light that is scattered: take p1")
    lights = {f"lights.{i}": decompose_lights([light]) for i, light in enumerate(scene.lights)}
    ambient = ambient_radiance([*chain(*lights.values())], medium.g)
    box, cells, cell = _Box(medium, lit), average_cells(medium), math.prod(medium.grid.spacing)
    crossings = {name: box.cross(sources) for name, sources in lights.items()}
    if lit:
        crossings["ground"] = box.cross_upwards(ambient.flatten())
    enters = {name: crossing[:2].sum((0, 1, 2)) for name, crossing in crossings.items()}
    if cells.emission is not None:
        enters["emission"] = 4 * math.pi * cell * cells.emission.double().sum((1, 2, 3))
    if not any(bool((power > 0).any()) for power in enters.values()):
        raise UsageError("lights: none enters the volume, so there is nothing to balance")
    swept = _sweep_out(light_field, DIRECTIONS[settings.angles], medium.index**2 * ambient, box.up)
    _, reflected, outflow = reduce(torch.add, crossings.values(), box.nothing)
    outflow = reduce(
        torch.add, (_leave_turned(b, box) for b in light_field.turned), outflow + swept
    )
    lost = cells.absorption.value * fluence_of(light_field, settings)
    powers: dict[str, Any] = {"enters": enters}
    if medium.index != 1:
        powers["reflected"] = reflected.sum((0, 1))
    powers["absorbed"] = cell * lost.sum((1, 2, 3), dtype=torch.float64)
    powers["leaves"] = {
        face: power
        for face, power in zip(FACES, outflow.sum(0), strict=True)
        if "zyx".index(face[1]) not in medium.grid.periodic
    }
    if lit:
        powers["into_ground"] = outflow[0].sum(0)
    entered = reduce(torch.add, enters.values())
    defect = 100 * (1 - (powers["absorbed"] + (reflected + outflow).sum((0, 1))) / entered)
    return {
        **_plain(powers, torch.ones_like(entered)),
        "fractions": _plain(powers, entered),
        "defect_percent": _plain(defect, torch.ones_like(entered)),
    }


def _plain(value: Any, unit: Tensor) -> Any:
    """Tensors [C] in `value`, over `unit` [C], as plain numbers, or lists of three."""
    if isinstance(value, dict):
        return {key: _plain(entry, unit) for key, entry in value.items()}
    numbers = (value / unit).tolist()
    return numbers[0] if len(numbers) == 1 else numbers


@dataclass(frozen=True)
class _Box:
    """A box with its `medium`, over the ground `lit`.

    Power leaves by each of `FACES`, downwards and upwards, [2, 6, C]. Of what crosses the box it is
    what would leave if that were empty, what faces reflect outside, and what passes unscattered,
    [3, 2, 6, C]. Ambient light passes whole: what the medium takes of it sweeps find.
    """

    medium: Medium
    lit: LitGround | None

    @property
    def up(self) -> int:
        """The axis that points up; any where no ground asks for it."""
        return self.lit.ground.plane.axis if self.lit else 1

    @property
    def areas(self) -> list[float]:
        """Areas of the faces across each axis; 0 along a period, which has none."""
        grid = self.medium.grid
        sides = enumerate(grid.extent)
        return [(axis not in grid.periodic) * math.prod(grid.extent) / side for axis, side in sides]

    @property
    def nothing(self) -> Tensor:
        """What crosses where no light shines."""
        return self.medium.g.new_zeros(3, 2, len(FACES), 1, dtype=torch.float64)

    def cross(self, sources: Sequence[Source]) -> Tensor:
        """What crosses of the `sources` of a light that the ground does not hide."""
        crossing = self.nothing
        for source in stay_above(sources, self.lit.ground.plane) if self.lit else sources:
            if isinstance(source, AmbientLight):
                crossing = crossing + self._cross_evenly(source.radiance, (True, self.lit is None))
            elif isinstance(source, Sky):
                for travel, power in zip(source.travel, source.irradiance, strict=True):
                    region = DirectionalLight(array_order(travel), power)
                    crossing = crossing + self._follow(region, turns=0)
            else:
                crossing = crossing + self._follow(source)
        return crossing

    def cross_upwards(self, ambient: Tensor) -> Tensor:
        """What crosses of the ground's light: `ambient` light [C], and what that sends more."""
        crossing = self._cross_evenly(ambient, (False, True))
        for direction, angle in zip(*hemisphere(self.up, UPWARDS, 1.0), strict=True):
            light = DirectionalLight(array_order(direction).to(ambient), angle[None].to(ambient))
            crossing = crossing + self._follow(light, ambient)
        return crossing

    def _cross_evenly(self, radiance: Tensor, sides: tuple[bool, bool]) -> Tensor:
        """What crosses of a `radiance` [C] that is the same everywhere: `sides` are down and up."""
        halves, index = torch.full((2, len(FACES)), 0.5), self.medium.index
        halves[:, 2 * self.up : 2 * self.up + 2] = torch.eye(2)
        areas = torch.tensor(self.areas, dtype=torch.float64).repeat_interleave(2)
        falling = math.pi * (halves * areas)[..., None].to(radiance.device) * radiance
        empty = falling if index == 1 else transmitted_moments(index)[0] * index**2 * falling
        crossing = torch.stack([empty, falling - empty, empty])
        return crossing * crossing.new_tensor(sides).view(2, 1, 1)

    def _follow(self, light: Beamed, ambient: Tensor | None = None, turns: int = TURNS) -> Tensor:
        """What crosses of a beam, along rays to the middles of cells at faces.

        With `ambient` it is that times what the ground sends more than this radiance [C]. `turns`:
        how often it is followed on where faces reflect it inside.
        """
        if self.medium.index != 1:
            return self._follow_refracted(light, turns)
        grid, field, powers = self.medium.grid, self.medium.extinction.field, list[Tensor]()
        for axis, side in product(range(3), range(2)):
            lines, size = grid.centers(field), list(grid.spacing)
            lines[axis] = field.new_full((1, 1, 1), (grid.lower, grid.upper)[side][axis])
            points, size[axis] = torch.stack(torch.broadcast_tensors(*lines), -1).flatten(0, 2), 0.0
            rays, travel, irradiance = shine_on(light, points, grid, max(grid.spacing), size)
            if ambient is not None and self.lit and self.lit.sent:
                plane, (even, texels) = self.lit.ground.plane, self.lit.sent
                met = plane.meet(points, travel)
                places = (met[:, across] for across in plane.across)
                more = look_up_texels(texels, self.lit.grid, plane, *places)
                irradiance = irradiance * ((even - ambient)[:, None] + more)
            out = self.areas[axis] / len(points) * (2 * side - 1)
            power = irradiance * (out * travel[:, axis]).clamp(min=0)
            passing = power
            if bool(power.any()):
                passing = power * transmittance(self.medium, rays, RAY_BY_RAY)
            leaving = torch.stack(torch.broadcast_tensors(power, 0 * power, passing)).double()
            powers.append(_split(leaving, travel[:, self.up]).sum(-1))
        return torch.stack(torch.broadcast_tensors(*powers), 2)

    def _follow_refracted(self, light: Beamed, turns: int) -> Tensor:
        """What crosses of a beam that faces refract, and reflect inside so often."""
        assert not isinstance(light, PointLight)
        powers, medium = list[Tensor](), self.medium
        for beam in enter_faces(medium.grid, medium.index, light):
            assert beam.face is not None and beam.at_face is not None
            cosine = array_order(beam.light.direction)[beam.face].abs()
            spacing = medium.grid.spacing
            area = math.prod(spacing) / spacing[beam.face] * cosine * beam.at_face.sum()
            entering = (area * beam.light.irradiance).expand(len(FACES), -1) / len(FACES)
            outer = reflectance(cosine, medium.index)
            # Of light that only grazes a face nothing enters.
            outside = outer / (1 - outer).clamp(min=1e-9) * entering
            passages = follow_inside(medium, beam, turns)
            released = reduce(torch.add, (passage.released for passage in passages))
            crossing = torch.broadcast_tensors(entering, outside, released)
            powers.append(torch.stack(crossing).double())
        power = reduce(torch.add, powers)
        return torch.stack([power, 0 * power], 1)


def _sweep_out(light_field: LightField, directions: int, inflow: Tensor, up: int) -> Tensor:
    """The power that leaves in one sweep of what scatters and is emitted, less `inflow`.

    Light that faces reflect inside is swept until it has come to rest.
    """
    medium, received = light_field.medium, light_field.received.source
    grid, cells = medium.grid, average_cells(medium)
    source = fill(
        add(weigh(light_field.diffuse, remaining_moments(medium)), received), medium.degree
    )
    moments = emitted_light(cells, cut(source), inflow)
    if cells.emission is not None:
        moments = add(moments, cells.emission[None])
    gradient = steep_gradient(cells, light_field.diffuse[0] + received[0], directions)
    courses, weights, values = sweep_rule(directions, len(moments))
    mirror, rows = face_mirror(medium, directions), values.to(moments)
    for sweep in range(1 if mirror is None else SWEEPS):
        if mirror is not None:
            mirror.begin(None if sweep else fill(light_field.diffuse, medium.degree))
        power = moments.new_zeros(2, len(FACES), 1, dtype=torch.float64)
        for number, (direction, weight) in enumerate(zip(courses, weights, strict=True)):
            emitted = torch.tensordot(rows[number], moments, 1)
            ends = None if mirror is None else mirror.entering(number)
            rise = gradient.expand(3, *emitted.shape)
            _, out = radiance_along(grid, cells.extinction.value, emitted, rise, direction, ends)
            if mirror is not None:
                mirror.outgoing.append(out)
                out = mirror.released(number)
            gone = power.new_zeros(len(FACES), out[0].shape[-3])
            course = Characteristic.of(grid, direction)
            scale = 4 * math.pi * weight * math.prod(grid.spacing) / course.step
            for place, (axis, layer) in enumerate(zip(course.axes, out, strict=True)):
                moved, across = course.moved[axis], [d for d in range(3) if d != bool(place)]
                if moved and axis not in grid.periodic:
                    lost = layer.sum(across, dtype=torch.float64)
                    gone[2 * axis + (moved > 0)] = scale * abs(moved) * lost
            power = power + _split(gone, direction[up])
    return power


def _leave_turned(beam: ReversedBeam, box: _Box) -> Tensor:
    """The power of a turned `beam` (E8.11), at faces the line through two cells."""
    power = beam.radiance.new_zeros(len(FACES), len(beam.radiance), dtype=torch.float64)
    for axis, along in enumerate(beam.direction.tolist()):
        layers = beam.radiance.unbind(1 + axis)[:: -1 if along > 0 else 1]
        last, before = layers[0], layers[min(1, len(layers) - 1)]
        end, cells = (1.5 * last - 0.5 * before).clamp(min=0), last[0].numel()
        power[2 * axis + (along > 0)] = (
            4 * math.pi * abs(along) * box.areas[axis] / cells * end.sum((1, 2))
        )
    return _split(power, beam.direction[box.up])


def _split(power: Tensor, rise: Tensor | float) -> Tensor:
    """`power` of light that rises so much, downwards and upwards; of level light half each."""
    share = (1 + torch.as_tensor(rise).sign()) / 2
    return torch.stack([(1 - share) * power, share * power], -3)


def lines(report: dict[str, Any]) -> list[str]:
    """The balance as lines of text."""

    def text(value: float | list[float], form: str) -> str:
        return ", ".join(format(number, form) for number in torch.tensor(value).view(-1).tolist())

    shares = report["fractions"]
    texts = [f"enters by {name}: {text(power, '.4g')}" for name, power in report["enters"].items()]
    if "reflected" in shares:
        texts.append(f"reflected from outside: {text(shares['reflected'], '.2%')}")
    texts.append(f"absorbed: {text(report['absorbed'], '.4g')} ({text(shares['absorbed'], '.2%')})")
    for face, leaving in shares["leaves"].items():
        texts.append(f"leaves by {face}: {text(leaving, '.2%')}")
    if "into_ground" in shares:
        texts.append(f"into the ground: {text(shares['into_ground'], '.2%')}")
    return [*texts, f"neither absorbed nor left: {text(report['defect_percent'], '.2g')} %"]
