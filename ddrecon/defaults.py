"""What the medium of a scene chooses where settings leave something out."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from ddrecon.grid import Triple
from ddrecon.light.ground import Ground
from ddrecon.march.samplers import greatest_depth, mean_side
from ddrecon.medium.coefficients import Volume, for_cells
from ddrecon.settings import DiffusionSettings

MOST_ROUNDS = 16
"""Rounds until light comes to rest; in all cases measured it has by then."""
MORE_ROUNDS = 0.3, 0.6
"""Each of these that the second moment of the phase function exceeds (|g| of 0.55 and 0.77) adds a
round: a round multiplies what is left by about the second moment."""
FEW_ANGLES = 0.1
"""A second moment up to this (|g| of 0.32) needs no angles beyond diffusion's."""
THICK = 4.0
"""Degree 5 adds a round, or two where a cell has more optical depths: theta of E7.2 is below 1
then. Measured on half-spaces and slabs (docs/accuracy.md)."""
FINER, FINER_FLAT, MOST_CELLS, LONG = 1.5, 0.75, 2**20, 8.0
"""Cells of light become 3, then 9 times narrower where a cell has more than `FINER` optical depths
(`FINER_FLAT` in a flat medium), unless that makes more than `MOST_CELLS` cells. Measured on blocks,
half-spaces and merged balls (docs/accuracy.md). If it does, axes stay undivided along which nothing
varies and the box is `LONG` times as long as along another, up to three numbers for each cell."""
WIDE = 2.0
"""Sweeps go through halves of cells along axes along which these have more than `FINER` optical
depths still and are so many times as wide as along another (E2.18)."""
PARTS = 3
"""Cells that stay thick receive the light of suns in parts so many times as narrow (E5.10)."""
SOFT = 3.0
"""Where no face is dense and a cell has more optical depths, there is one round: later ones darken
soft edges. Measured on merged balls (docs/accuracy.md)."""
FLAT, BACKWARD = 0.5, 0.2
"""A medium is flat if its density on a face of the box exceeds `FLAT` times its mean: light leaves
on one side of a plane, which takes degree 5. A backward peak of more than `BACKWARD` of scattering
takes it as well. Measured on half-spaces, I3RC's step cloud and a plume (docs/accuracy.md)."""
MOST_EXCHANGES, LEFT_OUT = 4, 2e-3
"""Light goes to and fro between a ground and a volume that repeats until at most this part of it is
left out, by so many exchanges at most. Of another volume so much leaves sideways that one does."""
OPTIMIZED = 0.31
"""The second moment that stands for a phase function which is optimized: two rounds."""


def choose_diffusion(
    settings: DiffusionSettings, volume: Volume, media: Sequence[Volume], optimized: Collection[str]
) -> tuple[DiffusionSettings, str]:
    """`settings` with what they leave out chosen by the `media` of `volume`; and why.

    The phase function counts; where it is `optimized` it may become any, and counts as `OPTIMIZED`
    at least. The thickest cell and dense faces count where density is not optimized.
    """
    choices = settings.transport_rounds, settings.degree, settings.refine, settings.receive
    left_out = None in (*choices, settings.halve_along)
    if not settings.rounds or not left_out:
        return settings, ""
    second_moment = float(volume.phase.moments(3)[:, 2].abs().max())
    if any(name.partition(".")[0] in ("g", "phase") for name in optimized):
        second_moment = max(second_moment, OPTIMIZED)
    reasons = [f"a second moment of {second_moment:.3g} of the phase function"]
    depth, is_flat = sum(map(greatest_depth, media)), _is_flat(media)
    if any(name.endswith("density") for name in optimized):
        depth, is_flat = 0.0, False
    thin = FINER_FLAT if is_flat else FINER
    times, along = _choose_cells(settings, volume, media, depth / thin)
    if depth > thin:
        reasons.append(f"cells of {depth:.3g} optical depths")
    rounds, degree, causes = _choose_rounds(
        volume, optimized, second_moment, depth / times, is_flat
    )
    reasons += causes
    if settings.transport_tolerance is not None:
        rounds = MOST_ROUNDS
    receive = PARTS if depth / times > thin else 1
    chosen: dict[str, Any] = {"transport_rounds": rounds, "degree": degree, "refine": times}
    halved = _choose_halves(volume, media, depth, times, along)
    chosen |= {"receive": receive, "halve_along": halved}
    added = {key: value for key, value in chosen.items() if getattr(settings, key) is None}
    if settings.refine is None and times > 1 and along != settings.refine_along:
        reasons.append("too many cells to divide all")
        added["refine_along"] = along
    plain = ("receive", 1), ("halve_along", "none")
    words = ", ".join(f"{k} {value}" for k, value in added.items() if (k, value) not in plain)
    return replace(settings, **added), f"{words}: {', '.join(reasons)}"


def _choose_cells(
    settings: DiffusionSettings, volume: Volume, media: Sequence[Volume], excess: float
) -> tuple[int, str]:
    """How many times as narrow cells are, and along which axes, as of `choose_diffusion`.

    Cells have `excess` times as many optical depths as are thin.
    """
    times, along, most = settings.times, settings.refine_along, MOST_CELLS
    grid, varies = volume.grid, _axes_that_vary(media)
    if along != varies and along == "xyz" and grid.refine(3).cells > most:
        along, most = varies, 3 * MOST_CELLS // count_colors(volume, media)
    while settings.refine is None and times < 9 and excess > times:
        if grid.refine(3 * times, along).cells > most:
            break
        times *= 3
    return times, along


def _choose_halves(
    volume: Volume, media: Sequence[Volume], depth: float, times: int, along: str
) -> str:
    """The axes along which sweeps go through halves of cells, as of `choose_diffusion`.

    Across its mean side a cell of `volume` has so many optical depths at most; along `along` it is
    divided by `times`.
    """
    finer, mean = volume.grid.refine(times, along), mean_side(volume.grid)
    shapes = zip("xyz", finer.shape[::-1], finer.spacing[::-1], strict=True)
    sides = {axis: side for axis, cells, side in shapes if cells > 1}
    least = max(WIDE * min(sides.values(), default=0.0), FINER * mean / max(depth, 1e-9))
    varies = _axes_that_vary(media)
    axes = "".join(axis for axis, side in sides.items() if side > least and axis in varies)
    fits = volume.index == 1 and finer.refine(2, axes).cells <= 4 * MOST_CELLS
    return axes if axes and fits else "none"


def _choose_rounds(
    volume: Volume, optimized: Collection[str], second_moment: float, depth: float, is_flat: bool
) -> tuple[int, int, list[str]]:
    """Rounds, their degree, and why, as of `choose_diffusion`."""
    reasons, glows = list[str](), [volume.emission, volume.black_body]
    turns_back = float(volume.phase.peak_tail(3, 1, -1).max()) > BACKWARD
    rounds, degree = (
        1 + sum(second_moment > bound for bound in MORE_ROUNDS),
        3 if second_moment > FEW_ANGLES else 1,
    )
    if is_flat or turns_back:
        reasons.append("a medium up to a face of the box" if is_flat else "a backward peak")
        rounds, degree = rounds + 1 + (depth > THICK), 5
    elif depth > SOFT:
        rounds = 1
    elif "emission" in optimized or any(bool(x.any()) for x in glows if x is not None):
        # Around a small bright core diffusion is far too bright, and a single round too dark.
        reasons.append("emission")
        rounds = max(rounds, 2)
    if volume.grid.periodic:
        # With fewer directions too much light goes exactly along the axes that repeat.
        reasons.append("a volume that repeats")
        rounds, degree = max(rounds, 2), 5
    if volume.index != 1:
        # What faces reflect comes back again and again.
        reasons.append("faces that reflect light")
        rounds = max(rounds, 4)
    return rounds, degree, reasons


def _axes_that_vary(media: Iterable[Volume]) -> str:
    """The axes but those along which `media` are even in a box that is long: light hardly varies
    along these.
    """
    fields, axes = list[Tensor](), ""
    for medium in media:
        glows = medium.emission, medium.black_body
        all_fields = medium.density, medium.sigma_a, medium.sigma_s, *glows, medium.phase.cells
        fields += [field for field in all_fields if field is not None and field.ndim > 2]
        extent = medium.grid.extent
    for axis in range(3):
        is_long = extent[axis] > LONG * min(extent)
        if not is_long or any(_varies(field, axis) for field in fields):
            axes = "zyx"[axis] + axes
    return axes


def _varies(field: Tensor, axis: int) -> bool:
    if not field.stride(axis - 3):
        return False
    return not bool((field == field.narrow(axis - 3, 0, 1)).all())


def find_occupied(
    volume: Volume, media: Sequence[Volume], ground: Ground, optimized: Collection[str]
) -> tuple[Triple, Triple]:
    """Where the part of the box of `volume` begins and ends (z, y, x) that has any of `media`.

    Or that glows; 0 to 1 is all of the box. All of it counts along periodic axes and those of a map
    of the albedo of `ground`, where density is `optimized`, and where there is none.
    """
    grid, filled = volume.grid, volume.density.new_zeros(volume.grid.shape)
    for medium in media:
        filled = filled + medium.density * (medium.sigma_a.sum(0) + medium.sigma_s.sum(0))
    filled = filled if volume.emission is None else filled + for_cells(volume.emission).sum(0)
    places = filled.nonzero()
    is_open = len(places) > 0 and not any(name.endswith("density") for name in optimized)

    def ends(axis: int) -> tuple[float, float]:
        is_mapped = ground.albedo.ndim > 1 and axis != ground.plane.axis
        if not is_open or is_mapped or axis in grid.periodic:
            return 0.0, 1.0
        first, last = int(places[:, axis].min()), int(places[:, axis].max())
        return first / grid.shape[axis], (last + 1) / grid.shape[axis]

    z, y, x = ends(0), ends(1), ends(2)
    return (z[0], y[0], x[0]), (z[1], y[1], x[1])


def choose_exchanges(ground: Ground, is_periodic: bool, optimized: Collection[str]) -> int:
    """How often light goes to and fro between `ground` and a volume (E5.4).

    A layer that reflects the part R of light from below and passes the rest lacks A^(n+1) R^n (1-R)
    after n exchanges over an albedo A, most where R is n/(n+1).
    """
    albedo = 1.0 if "ground.albedo" in optimized else float(ground.mean_albedo.max())

    def lack(n: int) -> float:
        return albedo ** (n + 1) * n**n / (n + 1) ** (n + 1)

    count = 1
    while is_periodic and count < MOST_EXCHANGES and lack(count) > LEFT_OUT:
        count += 1
    return count


def _is_flat(media: Iterable[Volume]) -> bool:
    """Whether `media`, all together, go up to a face of the box."""
    faces, mean = np.zeros(6), 0.0
    for medium in media:
        size = float(medium.sigma_a.mean() + medium.sigma_s.mean())
        ends = (medium.density.select(axis, end) for axis in range(3) for end in (0, -1))
        faces += [size * float(face.mean()) for face in ends]
        mean += size * float(medium.density.mean())
    return bool(faces.max() > FLAT * mean)


def count_colors(volume: Volume, media: Iterable[Volume]) -> int:
    """How many colors light has in `volume`, of these `media`."""
    glows = [len(field) for field in (volume.emission, volume.black_body) if field is not None]
    return max(volume.phase.colors, *(len(medium.sigma_a) for medium in media), *glows)
