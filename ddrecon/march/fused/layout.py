"""What stands where in a node's values: the one record that fused kernels are made for."""

from __future__ import annotations

from dataclasses import dataclass

from ddrecon.numerics.chebyshev import COEFFICIENTS


@dataclass(frozen=True)
class Layout:
    """How many channels a node has of each kind, in the order they stand in.

    `colors` C leave the volume. A node holds the `extinction`'s field (K = 1 or C channels),
    `diffuse` light (1 or C), K masses for each of `beams` (whether it is a point light),
    `scattering` (0: it is the extinction's field again; else 1 or C), and `peak`: None without a
    forward peak, 0 where it is one number a color, else 1 or C channels. `phases`: 1, or C where
    colors have phase functions of their own. `bits` of a number: 32 or 64.

    Where the phase function differs from cell to cell, `form` is how it depends on the number that
    does (`cellwise`): a node holds these `numbers` (1 or C), of which there are so many `tables` (1
    or C), and 1 or C channels of what `remaining` scatters of diffuse light. Else None, 0 and 1.
    """

    colors: int
    extinction: int
    diffuse: int
    beams: tuple[bool, ...]
    scattering: int
    peak: int | None
    phases: int
    bits: int
    form: str | None = None
    numbers: int = 0
    tables: int = 1
    remaining: int = 0

    def written(self) -> str:
        """The arguments of `Layout` in C++, which finds there where each channel stands."""
        numbers = (
            self.colors,
            self.extinction,
            self.diffuse,
            self.scattering,
            -1 if self.peak is None else self.peak,
            self.phases,
            (self.form or "same").upper(),
            self.numbers,
            self.tables,
            self.remaining,
            *map(int, self.beams),
        )
        return ", ".join(map(str, numbers))

    @property
    def ray_terms(self) -> int:
        """Numbers of each beam that a ray is given: coefficients of p, or where to find them."""
        if self.form is None:
            return self.phases * COEFFICIENTS
        return 2 * self.tables if self.form == "linear" else 3

    @property
    def channels(self) -> int:
        """All channels of a node."""
        masses = len(self.beams) * self.extinction
        others = self.scattering + (self.peak or 0) + self.numbers + self.remaining
        return self.extinction + self.diffuse + masses + others

    @property
    def outputs(self) -> int:
        """Numbers a ray brings: C of diffuse light, then C of each beam."""
        return (1 + len(self.beams)) * self.colors
