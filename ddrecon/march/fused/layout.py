"""What stands where in a node's values: the one record that fused kernels are made for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Layout:
    """How many channels a node has of each kind, in the order they stand in.

    `colors` C leave the volume. A node holds the `extinction`'s field (K = 1 or C channels),
    `diffuse` light (1 or C), K masses for each of `beams` (whether it is a point light),
    `scattering` (0: it is the extinction's field again; else 1 or C), and `peak`: None without a
    forward peak, 0 where it is one number a color, else 1 or C channels. `bits` of a number: 32 or
    64.
    """

    colors: int
    extinction: int
    diffuse: int
    beams: tuple[bool, ...]
    scattering: int
    peak: int | None
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
    def channels(self) -> int:
        """All channels of a node."""
        return self.first_peak + (self.peak or 0)

    @property
    def outputs(self) -> int:
        """Numbers a ray brings: C of diffuse light, then C of each beam."""
        return (1 + len(self.beams)) * self.colors
