"""What a scene file may say of a phase function: one frozen record per kind.

They are read as all records of `schema` are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from ddrecon.scene_file.camera_schema import Pair
from ddrecon.scene_file.light_schema import Color
from ddrecon.settings import FieldFile, Problem, limited

Quantity = Color | FieldFile


@dataclass(frozen=True)
class HenyeyGreensteinSection:
    """`g`: mean cosine of the scattering angle."""

    type: ClassVar[str] = "henyey_greenstein"

    g: Quantity = limited(above=-1, below=1)


@dataclass(frozen=True)
class TwoLobeSection:
    """`weight` of a Henyey-Greenstein function with the first of `g`, the rest with the second."""

    type: ClassVar[str] = "two_lobe"

    g: Pair = limited(above=-1, below=1)
    weight: Quantity = limited(minimum=0, maximum=1)


@dataclass(frozen=True)
class RayleighSection:
    """Particles much smaller than the wavelength, as air."""

    type: ClassVar[str] = "rayleigh"


@dataclass(frozen=True)
class DraineSection:
    """A Henyey-Greenstein function times 1 + `alpha` cos^2, normalized."""

    type: ClassVar[str] = "draine"

    g: Color = limited(above=-1, below=1)
    alpha: Color = limited(minimum=0)


@dataclass(frozen=True)
class LegendreSection:
    """Legendre moments chi_0 = 1, chi_1, ..., in the scene or in a file."""

    type: ClassVar[str] = "legendre"
    ALTERNATIVES: ClassVar = (("coefficients",), ("file",))

    coefficients: tuple[float, ...] | None = None
    file: Path | None = None

    def problems(self) -> Iterator[Problem]:
        given = self.coefficients
        if given is not None and len(given) < 2:
            yield "coefficients", "needs chi_0 and chi_1 at least"
        elif given is not None and abs(given[0] - 1) > 1e-6:
            yield "coefficients", f"chi_0 must be 1, found {given[0]:g}; divide all by it"
        elif given is not None and max(map(abs, given)) > 1 + 1e-6:
            yield "coefficients", "must be within -1 and 1; divide each by 2 l + 1"


@dataclass(frozen=True)
class TableSection:
    """Values over angle or cosine, in a file."""

    type: ClassVar[str] = "table"

    file: Path


@dataclass(frozen=True)
class MieSection:
    """Spheres whose radii follow a gamma distribution, by Mie's theory; lengths in micrometers."""

    type: ClassVar[str] = "mie"

    wavelength: Color = limited(above=0, maximum=1e3)
    refractive_index: Color = limited(above=1, maximum=10)
    effective_radius: float = limited(above=0, maximum=100)
    effective_variance: float = limited(above=0, below=0.5)


PartSection = (
    HenyeyGreensteinSection
    | RayleighSection
    | DraineSection
    | LegendreSection
    | TableSection
    | MieSection
)
Parts = tuple[PartSection, ...]


@dataclass(frozen=True)
class BlendSection:
    """`weight` of the first of two phase functions, the rest of the second."""

    type: ClassVar[str] = "blend"

    phases: Parts
    weight: Quantity = limited(minimum=0, maximum=1)

    def problems(self) -> Iterator[Problem]:
        if len(self.phases) != 2:
            yield "phases", f"expected two phase functions, found {len(self.phases)}"
        if any(isinstance(getattr(part, "g", None), FieldFile) for part in self.phases):
            yield "phases", "of a blend the weight may differ from cell to cell, and no g"


PhaseSection = PartSection | TwoLobeSection | BlendSection
