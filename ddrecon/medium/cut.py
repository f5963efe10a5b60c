"""The part of a volume that a rank has where ranks share out its cells."""

from __future__ import annotations

from ddrecon.medium.coefficients import Volume
from ddrecon.slabs.slab import Slab, own_slab


def cut_volume(volume: Volume) -> Volume:
    """The slab of `volume` that this rank has; `volume` itself where ranks do not share cells."""
    slab = own_slab(volume.grid)
    if not isinstance(slab, Slab):
        return volume
    density, sigma_a, sigma_s = (
        slab.cut(field) if field.shape[-3:] == volume.grid.shape else field
        for field in (volume.density, volume.sigma_a, volume.sigma_s)
    )
    phase = volume.phase
    if phase.cells is not None:
        phase = phase.with_cells(slab.cut(phase.cells))
    support = None if volume.support is None else slab.cut(volume.support)
    return Volume(slab, density, sigma_a, sigma_s, phase, support=support)
