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

    @property
    def masses(self) -> int:
        """Channels of all beams' masses: those interpolated to third order."""
        return len(self.beams) * self.extinction

    @property
    def first_mass(self) -> int:
        """Where these begin."""
        return self.extinction + self.diffuse

    @property
    def first_scattering(self) -> int:
        """Where scattering begins."""
        return self.first_mass + self.masses

    @property
    def first_peak(self) -> int:
        """Where the peak begins."""
        return self.first_scattering + self.scattering

    @property
    def scattering_from(self) -> int:
        """Where the field of kappa_s begins, its own or the extinction's."""
        return self.first_scattering if self.scattering else 0

    @property
    def mass_step(self) -> int:
        """From the extinction of a color to that of the next one: 0 where all share one field."""
        return int(self.extinction > 1)

    @property
    def diffuse_step(self) -> int:
        """The same of diffuse light."""
        return int(self.diffuse > 1)

    @property
    def scattering_step(self) -> int:
        """The same of scattering."""
        return int(self.scattering > 1) if self.scattering else self.mass_step

    @property
    def peak_step(self) -> int:
        """The same of the peak."""
        return int((self.peak or 0) > 1)

    @property
    def phase_step(self) -> int:
        """The same of phase functions."""
        return int(self.phases > 1)

    @property
    def first_number(self) -> int:
        """Where the numbers of phase functions begin."""
        return self.first_peak + (self.peak or 0)

    @property
    def first_remaining(self) -> int:
        """Where what scatters diffuse light begins, if it is not what scatters beams."""
        return self.first_number + self.numbers

    @property
    def diffusing_from(self) -> int:
        """Where the field that scatters diffuse light begins."""
        return self.first_remaining if self.remaining else self.scattering_from

    @property
    def diffusing_step(self) -> int:
        """From that of a color to that of the next one."""
        return int(self.remaining > 1) if self.remaining else self.scattering_step

    @property
    def has_rungs(self) -> bool:
        """Whether p is looked up by a number that differs from cell to cell."""
        return self.form in ("even", "steep") and self.peak is not None

    @property
    def number_step(self) -> int:
        """From the number of a color to that of the next one."""
        return int(self.numbers > 1)

    @property
    def table_step(self) -> int:
        """From the table of a color to that of the next one."""
        return int(self.tables > 1) if self.form else self.phase_step

    @property
    def curve_step(self) -> int:
        """From coefficients of p that a ray is given to those of the next color."""
        return self.table_step * (COEFFICIENTS if self.form is None else 2)

    @property
    def terms(self) -> int:
        """Coefficients of p over the depth of the peak, or where there is none over the number."""
        if self.peak is not None:
            return COEFFICIENTS
        return 2 if self.form == "linear" else 1

    @property
    def ray_terms(self) -> int:
        """Numbers of each beam that a ray is given: coefficients of p, or where to find them."""
        if self.form is None:
            return self.phases * COEFFICIENTS
        return 2 * self.tables if self.form == "linear" else 3

    @property
    def channels(self) -> int:
        """All channels of a node."""
        return self.first_remaining + self.remaining

    @property
    def outputs(self) -> int:
        """Numbers a ray brings: C of diffuse light, then C of each beam."""
        return (1 + len(self.beams)) * self.colors
