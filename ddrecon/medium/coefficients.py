"""The participating medium: cross sections times density, with or without delta-Eddington scaling.

Colors are the leading axis, of size 1 (gray) or 3. A coefficient is kept as `scale * field`: where
cross sections are constant, rays need march through one field only, the density, for all colors.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Cells, Grid
from ddrecon.medium.phase import (
    Blend,
    HenyeyGreenstein,
    PhaseFunction,
    SeenPhase,
    henyey_greenstein,
    is_scaled,
    number_place,
    number_table,
    peak_moments,
    tabulate_series,
)
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.interpolation import resize
from ddrecon.numerics.layout import Unrolled
from ddrecon.numerics.remember import constant, is_any_nonzero, remember
from ddrecon.numerics.series import legendre, look_up, series_weights, sum_series
from ddrecon.records import bounded

P1_DEGREE = 1
"""Diffusion knows light to this degree in angle: its mean and its flux."""
NEARLY_NONE = 1e-6
"""So often each medium scatters besides across the box, for a weight where both are empty."""


@dataclass(eq=False, repr=False)
class Volume:
    """What a user describes: density, and cross sections per unit density, on a `grid`.

    `density`: [z, y, x], >= 0; `sigma_a`, `sigma_s`: absorption and scattering [1/u], >= 0, each
    [C] or per cell [C, z, y, x] with C = 1 or 3; `phase`: the phase function, or g in (-1, 1), the
    mean cosine of Henyey and Greenstein's. Tensors may be replaced or require gradients. `media`:
    what the volume was mixed from, by name (`mix_media`). `support` [z, y, x]: where it is 0 the
    volume counts as empty, and derivatives by density are 0; None: it is 1 everywhere.

    What glows has an `emission` >= 0, the radiance that a unit of length adds (E2.11), or is as
    bright as a `black_body` [radiance], whose light it emits as it absorbs: each [C] or
    [C, z, y, x], or None. `index`: the refractive index inside the box, outside of which it is 1.
    """

    grid: Grid
    density: Tensor
    sigma_a: Tensor
    sigma_s: Tensor
    phase: PhaseFunction
    media: Mapping[str, Volume] | None = None
    support: Tensor | None = None
    emission: Tensor | None = None
    black_body: Tensor | None = None
    index: float = bounded(1.0, minimum=1)

    def __post_init__(self) -> None:
        if isinstance(self.phase, Tensor):
            self.phase = HenyeyGreenstein(self.phase)

    @property
    def g(self) -> Tensor:
        """The mean cosine of Henyey and Greenstein's phase function.

        It may be replaced. Raises AttributeError where the volume has another phase function.
        """
        if isinstance(self.phase, HenyeyGreenstein):
            return self.phase.g
        raise AttributeError(f"the phase function is {self.phase.NAME}: see volume.phase")

    @g.setter
    def g(self, g: Tensor) -> None:
        self.phase = HenyeyGreenstein(g)


@dataclass(frozen=True)
class Coefficient:
    """A coefficient [1/u]: `scale` [C, 1, 1, 1] times `field` [K, z, y, x] with K = 1 or C."""

    scale: Tensor
    field: Tensor

    @property
    def value(self) -> Tensor:
        """The coefficient itself, `[C, z, y, x]`."""
        return self.scale * self.field

    @property
    def mass_bound(self) -> Tensor:
        """1 over the most by which third-order corrections may change an integral of `field`.

        That is half an optical depth, in the mean over colors.
        """
        return _twice_mean(self.scale)

    def mean_transmittance(self, entered: Tensor, step: Tensor) -> Tensor:
        """exp(-depth) averaged over each cell, `[C, z, y, x]`.

        `entered` [K, z, y, x]: the integral of `field` up to where light enters the cell; `step`:
        the light's path through the cell [u], scalar or [z, y, x].
        """
        return torch.exp(-self.scale * entered) * decay_mean(self.scale * (self.field * step))


@remember
def _twice_mean(scale: Tensor) -> Tensor:
    return 2 * scale.mean()


@dataclass(frozen=True)
class Medium:
    """Coefficients of a medium of whose scattering the part f counts as not scattered.

    f is `forward_fraction`, the forward peak's. `absorption` is kappa_a. `scattering` is all of
    kappa_s, by which beams scatter with the exact phase function `seen`, of mean cosine `g`.
    `remaining` is (1 - f) kappa_s, and `extinction` kappa_a more. f and g are scalars,
    [3, 1, 1, 1] where colors differ, or [C, z, y, x] where the phase function does from cell to
    cell. `peak` is f kappa_s per unit of the extinction's field: times a mass, it is the depth x of
    E8.7. It is [C, 1, 1, 1], or [C, z, y, x] where anything of it varies, and None without a peak.
    `emission` j [C, z, y, x] is the radiance that a unit of length adds (E2.11), None where nothing
    glows. `support` and `index` are the volume's. Sweeps go through halves of its cells along the
    axes `halved` (E2.18): means of cells hold these `halves`, None where there are none.
    """

    grid: Grid
    extinction: Coefficient
    scattering: Coefficient
    remaining: Coefficient
    absorption: Coefficient
    g: Tensor
    forward_fraction: Tensor
    peak: Tensor | None
    seen: SeenPhase
    support: Tensor | None = None
    emission: Tensor | None = None
    index: float = 1.0
    halved: str = ""
    halves: Medium | None = None

    @property
    def remaining_scattering(self) -> Tensor:
        """(1 - f) kappa_s [1/u], `[C, z, y, x]`."""
        return self.remaining.value

    @property
    def transport_extinction(self) -> Tensor:
        """kappa_tr = kappa_a + (1 - g) kappa_s [1/u], `[C, z, y, x]`.

        Delta-Eddington scaling leaves it unchanged.
        """
        return self.absorption.value + (1 - self.g) * self.scattering.value

    @property
    def emitting(self) -> Medium:
        """One that scatters of even light of radiance 1 what this one emits (E2.11)."""
        assert self.emission is not None
        scale = self.emission.new_ones(1, 1, 1, 1)
        halves = None if self.halves is None else self.halves.emitting
        return replace(self, remaining=Coefficient(scale, self.emission), halves=halves)

    @property
    def has_flux(self) -> bool:
        """Whether light's direction matters to scattering: g is not 0, or is being varied."""
        return is_varied(self.g) or is_any_nonzero(self.g)

    @property
    def is_cellwise(self) -> bool:
        """Whether the phase function differs from cell to cell."""
        return self.seen.phase.cells is not None

    @property
    def degree(self) -> int:
        """The degree in angle to which light is known: 0 where its direction does not matter."""
        is_directed = self.is_anisotropic if self.seen.degree > P1_DEGREE else self.has_flux
        return self.seen.degree if is_directed else 0

    @property
    def is_anisotropic(self) -> bool:
        """Whether the phase function differs from that of isotropic scattering, or may come to."""
        return self.has_flux or not isinstance(self.seen.phase, HenyeyGreenstein)

    def mapped(self, function: Callable[[Tensor], Tensor], *others: str, **changed: Any) -> Medium:
        """With what `function` makes of its coefficients' fields, and of `others` that are fields.

        `changed` are values in place of its own.
        """
        names = "extinction", "scattering", "remaining", "absorption"
        fields = {name: getattr(self, name).field for name in names}
        # A field that coefficients share is moved once, and they share it there as well.
        different = {id(field): field for field in fields.values()}
        moved = {key: function(field) for key, field in different.items()}
        for name, field in fields.items():
            changed[name] = replace(getattr(self, name), field=moved[id(field)])
        for name in others:
            value = getattr(self, name)
            if value is not None and tuple(value.shape[-3:]) == self.grid.shape:
                changed[name] = function(value)
        return replace(self, **changed)

    def put(self, grid: Grid, put: Callable[[Tensor], Tensor]) -> Medium:
        """This medium on another `grid`, where `put` takes each of its fields [..., z, y, x]."""
        cellwise = ["g", "forward_fraction"] if self.is_cellwise else []
        seen = replace(self.seen, phase=self.seen.phase.move_cells(put))
        return self.mapped(put, "support", "emission", "peak", *cellwise, grid=grid, seen=seen)


def put_volume(volume: Volume, grid: Grid, put: Callable[[Tensor], Tensor]) -> Volume:
    """`volume` on another `grid`, where `put` takes each of its fields [..., z, y, x]."""
    names = "density", "sigma_a", "sigma_s", "support", "emission", "black_body"
    values = {name: getattr(volume, name) for name in names}
    fields: dict[str, Any] = {
        name: put(value) for name, value in values.items() if value is not None and value.ndim >= 3
    }
    return replace(volume, grid=grid, phase=volume.phase.move_cells(put), media=None, **fields)


def keep_medium(volume: Volume) -> Medium:
    """The medium of `volume` as it is, with f = 0.

    Path tracing separates single from multiple scattering by it.
    """
    return scale_medium(volume, P1_DEGREE, volume.density.new_zeros(()))


def scale_medium(volume: Volume, degree: int = P1_DEGREE, fraction: Tensor | None = None) -> Medium:
    """The delta-Eddington scaled medium of `volume`, by which the whole image is rendered.

    f is the `fraction`, by default what of the phase function lies beyond `degree`. Source: Joseph,
    Wiscombe, Weinman 1976, doi:10.1175/1520-0469(1976)033<2452:TDEAFR>2.0.CO;2.
    """
    g = _mean_cosine(volume.phase)
    fraction = peak_fraction(volume.phase, degree, 1) if fraction is None else fraction
    sigma_a, sigma_s = _broadcast(volume.sigma_a, g), _broadcast(volume.sigma_s, g)
    by_cell = sigma_s[0].numel() > 1 and not is_varied(sigma_s)
    if by_cell and not is_any_nonzero(volume.sigma_s):
        sigma_s = sigma_s[:, :1, :1, :1]  # nothing scatters, whatever the cell
    find = _find_coefficients
    if max(sigma_a[0].numel(), sigma_s[0].numel()) > 1:
        # Of what varies from cell to cell nothing is kept that is made on the way.
        find = functools.partial(recompute, find)
    density = volume.density if volume.support is None else volume.density * volume.support
    extinction, scattering, remaining, absorption, peak = find(sigma_a, sigma_s, fraction, density)
    return Medium(
        volume.grid,
        extinction=extinction,
        scattering=scattering,
        remaining=remaining,
        absorption=absorption,
        g=g,
        forward_fraction=fraction,
        peak=peak,
        seen=SeenPhase(volume.phase, degree),
        support=volume.support,
        emission=_find_emission(volume, absorption),
        index=volume.index,
    )


def _find_emission(volume: Volume, absorption: Coefficient) -> Tensor | None:
    """j of E2.11: what is given, within the support, or kappa_a times a black body's radiance.

    Within a refractive index n that is n^2 times as bright (E2.13).
    """
    if volume.black_body is not None:
        return absorption.value * (volume.index**2 * for_cells(volume.black_body))
    if volume.emission is None:
        return None
    emission = for_cells(volume.emission).expand(-1, *volume.grid.shape)
    return emission if volume.support is None else emission * volume.support


def _find_coefficients(
    sigma_a: Tensor, sigma_s: Tensor, fraction: Tensor, density: Tensor
) -> tuple[Coefficient, Coefficient, Coefficient, Coefficient, Tensor | None]:
    """kappa_a + (1 - f) kappa_s, kappa_s, (1 - f) kappa_s, kappa_a, and `peak` of `Medium`."""
    field = density[None]

    def coefficient(sigma: Tensor) -> Coefficient:
        if sigma.shape[1:].numel() == 1:
            return Coefficient(sigma, field)
        return Coefficient(along_colors(constant([1.0] * len(sigma), sigma)), sigma * field)

    is_small = max(sigma_a[0].numel(), sigma_s[0].numel(), fraction.numel() // 3) == 1
    scale = _remember_scaled if is_small else _scale_sections
    sigma_t, unpeaked, peak = scale(sigma_a, sigma_s, fraction, is_any_nonzero(fraction))
    scattering = coefficient(sigma_s)
    if sigma_s[0].numel() > 1 and fraction.shape[1:].numel() == 1:
        # One field for both, as cells share what remains of their scattering.
        remaining = Coefficient((1 - fraction) * scattering.scale, scattering.field)
    else:
        remaining = coefficient(unpeaked)
    return coefficient(sigma_t), scattering, remaining, coefficient(sigma_a), peak


def _scale_sections(
    sigma_a: Tensor, sigma_s: Tensor, fraction: Tensor, has_peak: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Extinction and scattering that remain beside a peak of part f, per unit density (E8.4).

    And what `Medium` has as `peak`. `sigma_a` and `sigma_s`: [C, 1, 1, 1] or [C, z, y, x];
    `fraction`: f, which broadcasts to them.
    """
    remaining = (1 - fraction) * sigma_s
    extinction = sigma_a + remaining
    if not has_peak:
        return extinction, remaining, None
    mass, forward = torch.broadcast_tensors(extinction, fraction * sigma_s)
    if mass.shape[1:].numel() == 1:
        return extinction, remaining, forward
    # Per unit of what is summed as mass: of the extinction where that varies, else of density.
    peak = torch.where(mass > 0, forward / torch.where(mass > 0, mass, 1), 0)
    return extinction, remaining, peak


_remember_scaled = remember(_scale_sections)


@remember
def _mean_cosine(phase: PhaseFunction) -> Tensor:
    return _by_color(phase.moments(2)[:, 1])


@remember
def peak_fraction(phase: PhaseFunction, degree: int, sign: int) -> Tensor:
    """The part of scattering that a peak is, f or b by the `sign`, as of `Medium`."""
    return _by_color(phase.peak_tail(degree, 1, sign)[:, 0])


def _by_color(numbers: Tensor) -> Tensor:
    """One number for each color, [1 or 3], as a scalar or `[3, 1, 1, 1]`; of cells as they are."""
    if numbers.ndim != 4:
        numbers = numbers[0] if len(numbers) == 1 else numbers.view(-1, 1, 1, 1)
    return numbers + 0


def _broadcast(sigma: Tensor, g: Tensor) -> Tensor:
    """`sigma` as [C, z, y, x], with as many colors as `g` has."""
    sigma = for_cells(sigma)
    return sigma if len(sigma) > 1 or g.shape[:1] != (3,) else sigma.expand(3, -1, -1, -1)


def for_cells(values: Tensor) -> Tensor:
    """`values` [C], or [C, z, y, x] as they are, as a tensor that broadcasts to cells."""
    return values if values.ndim == 4 else along_colors(values)


@remember
def along_colors(sigma: Tensor) -> Tensor:
    """Numbers of each color [C] as `[C, 1, 1, 1]`."""
    # A tensor of its own, not a view: what depends on it is remembered as well.
    return sigma.view(-1, 1, 1, 1) + 0


def thinness(grid: Grid, extinction: Tensor, depth: float) -> Tensor:
    """From 1 where cells are thin to 0 where they are thick, [C, z, y, x]; 1/2 at a `depth`."""
    # to the fourth power, which must not overflow
    ratio = mean_width(grid) / depth * extinction
    return 1 / (1 + (ratio / (1 + 1e-6 * ratio)).square().square())


def for_channels(values: Tensor, count: int) -> Tensor:
    """`values` [C, ...] of colors for `count` channels, which are theirs again and again."""
    times = count // len(values)
    return values.repeat(times, *[1] * (values.ndim - 1)) if times > 1 else values


def mean_width(grid: Grid) -> float:
    """That of a cell by whose optical depth it is thin or thick [u]."""
    return float((sum(width**-2 for width in grid.spacing) / 3) ** -0.5)


def mix_media(media: Mapping[str, Volume]) -> Volume:
    """The volume of two `media` on the same grid, of density 1 (E8.10).

    It holds them as `media`. Its phase function is a blend of theirs, which are the same in all
    cells and no mixtures. What glows, a support and an index are the mixture's own: `replace` it
    with these. Raises ValueError for another number of media, where grids differ, and for media
    that have any of these.
    """
    if len(media) != 2 or len({medium.grid for medium in media.values()}) != 1:
        raise ValueError("a mixture is of two media on the same grid")
    for name, medium in media.items():
        glows = medium.emission is not None or medium.black_body is not None
        if glows or medium.support is not None or medium.index != 1:
            keys = "emission, black_body, support and index"
            raise ValueError(f"media.{name}: {keys} are for the mixture, not for a medium of it")
    first, second = media.values()
    grid = first.grid
    absorbing = [for_cells(medium.sigma_a) * medium.density for medium in (first, second)]
    scattering = [for_cells(medium.sigma_s) * medium.density for medium in (first, second)]
    besides = NEARLY_NONE / math.hypot(*grid.extent)
    sigma_a, sigma_s = absorbing[0] + absorbing[1], scattering[0] + scattering[1]
    weight = (scattering[0] + besides) / (sigma_s + 2 * besides)
    phase = Blend(first.phase, second.phase, weight)
    colors = max(len(sigma_a), len(sigma_s), phase.colors)
    sigma_a, sigma_s = (sigma.expand(colors, *grid.shape) for sigma in (sigma_a, sigma_s))
    return Volume(grid, torch.ones_like(first.density), sigma_a, sigma_s, phase, media=media)


def remix(volume: Volume, media: Mapping[str, Volume]) -> Volume:
    """`volume` of other `media` on its grid; all else, as what glows, is its own."""
    mixed = mix_media(media)
    sigma_a, sigma_s = mixed.sigma_a, mixed.sigma_s
    return replace(volume, sigma_a=sigma_a, sigma_s=sigma_s, phase=mixed.phase, media=media)


def volume_at_level(volume: Volume, grid: Grid, cells: Cells | None = None) -> Volume:
    """`volume` on a coarser `grid`, each medium by itself; that may span some `cells` alone."""

    def put(field: Tensor) -> Tensor:
        return resample(field if cells is None else field[..., cells[0], cells[1], cells[2]], grid)

    support, volume = volume.support, copy(volume)
    if support is not None:
        volume.support = None
        if volume.emission is not None:
            volume.emission = for_cells(volume.emission) * support
        if volume.media is None:
            volume.density = volume.density * support
        else:
            volume.media = {
                name: replace(medium, density=medium.density * support)
                for name, medium in volume.media.items()
            }
    coarse = put_volume(volume, grid, put)
    if volume.media is None:
        return coarse
    media = volume.media.items()
    return remix(coarse, {name: volume_at_level(medium, grid, cells) for name, medium in media})


def refine_medium(medium: Medium, times: int, along: str = "xyz") -> Medium:
    """`medium` in cells an odd number of `times` as narrow `along` axes.

    It is the same between all its centers, which are centers there as well.
    """
    finer = medium.grid.refine(times, along)
    return medium.put(finer, functools.partial(resample, grid=finer)) if times > 1 else medium


def resample(field: Tensor, grid: Grid) -> Tensor:
    """`field` [..., z, y, x] on `grid`, which spans the same box.

    It is averaged where `grid` is coarser, trilinearly interpolated where it is finer, and around
    along periodic axes. Of what is true or false, cells are true that have any of it.
    """
    shape = field.shape[-3:]
    if tuple(shape) == grid.shape:
        return field
    if field.dtype == torch.bool:
        return resample(field.float(), grid) > 0
    if shape.numel() > grid.cells:
        return resize(field, grid.shape, "area")
    # Around periodic axes the fewest cells more on both sides that are whole cells of both.
    before, after = [0, 0, 0], [0, 0, 0]
    for axis in grid.periodic:
        common = math.gcd(shape[axis], grid.shape[axis])
        before[axis], after[axis] = shape[axis] // common, grid.shape[axis] // common
    wide, around = (Unrolled(grid, tuple(ends), tuple(ends)) for ends in (before, after))
    return around.crop(resize(wide.extend(field), around.wide.shape, "linear"))


def remaining_moments(medium: Medium) -> Tensor:
    """p_l = (chi_l - f) / (1 - f) for l up to the medium's degree (E8.4), [L + 1, C or 1, 1, 1, 1].

    chi_l are the moments of the phase function of `medium`, f the part of its forward peak. Of one
    that differs from cell to cell they are [L + 1, C or 1, z, y, x].
    """
    return _remaining(medium.seen.phase, medium.forward_fraction, medium.seen.degree)


@remember
def _remaining(phase: PhaseFunction, fraction: Tensor, degree: int) -> Tensor:
    moments = phase.moments(degree + 1).transpose(0, 1)
    moments = moments if moments.ndim == 5 else moments[..., None, None, None]
    return (moments - fraction) / (1 - fraction)


def unturned_moments(medium: Medium) -> Tensor:
    """p_l - (-1)^l b / (1 - f), of what beams scatter that keep their backward peak b (E8.11).

    As `remaining_moments`.
    """
    turned = backward_fraction(medium) / (1 - medium.forward_fraction)
    moments = remaining_moments(medium)
    sign = 1 - 2 * (torch.arange(len(moments), device=turned.device) % 2).to(turned)
    return moments - sign.view(-1, 1, 1, 1, 1) * turned


def backward_fraction(medium: Medium) -> Tensor:
    """b, the part of scattering that counts as turned back (E8.11), shaped as f of `Medium`."""
    return peak_fraction(medium.seen.phase, medium.seen.degree, -1)


def has_backward_peak(medium: Medium) -> bool:
    """Whether a part of scattering counts as turned back: not by diffusion alone."""
    return medium.seen.degree > P1_DEGREE and is_any_nonzero(backward_fraction(medium))


@remember
def turned_table(phase: PhaseFunction, degree: int, turns: int) -> Tensor:
    """How light that a backward peak has turned scatters once more, towards a camera (E8.12).

    A table [C, steps + 1, 2, 1] for `look_up` over the angle from the way that light goes. Its
    moments are chi_l up to `degree`, and chi_l r_l^turns beyond, where r_l are the backward peak's;
    less the forward peak's, which counts as not scattered.
    """
    forward, _ = peak_moments(phase, degree)
    _, spread = peak_moments(phase, degree, -1)
    moments = phase.moments(phase.length()).double() - forward
    return tabulate_series(series_weights(moments * spread**turns)[..., None])


def turned_in_cells(medium: Medium, turns: int, angle: Tensor) -> Tensor:
    """How light turned so often scatters by `angle` [z, y, x] in cells, [C, z, y, x] (E8.12)."""
    phase, degree = medium.seen.phase, medium.seen.degree
    number = phase.cells
    assert number is not None
    cosine = angle.cos().to(number)
    table = number_table(phase, turned_table, True, -1, degree, turns).to(number)
    coefficients = look_up(table, angle.double()).unbind(-1)
    if not is_scaled(phase):
        return sum_series(coefficients, number_place(phase, number))
    turned = sum_series(coefficients, number_place(phase, -number))
    # Where g is positive nothing is turned back, and the forward peak counts as not scattered.
    moments = (phase.moments(degree + 1) - phase.peak_tail(degree, 1)).movedim(1, -1)
    forward = (series_weights(moments) * legendre(cosine, degree + 1)).sum(-1)
    return torch.where(number < 0, henyey_greenstein(cosine, number) * turned, forward)
