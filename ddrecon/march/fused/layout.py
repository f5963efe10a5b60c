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
    """

    colors: int
    extinction: int
    diffuse: int
    beams: tuple[bool, ...]
    scattering: int
    peak: int | None
    phases: int
    bits: int

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
    def terms(self) -> int:
        """Coefficients of p over the depth of the peak: 1 where there is none."""
        return 1 if self.peak is None else COEFFICIENTS

    @property
    def channels(self) -> int:
        """All channels of a node."""
        return self.first_peak + (self.peak or 0)

    @property
    def outputs(self) -> int:
        """Numbers a ray brings: C of diffuse light, then C of each beam."""
        return (1 + len(self.beams)) * self.colors
