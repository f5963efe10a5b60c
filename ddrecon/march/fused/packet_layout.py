"""C++ of packets of rays: the numbers of a layout, by which their text is compiled."""

from __future__ import annotations

from typing import NamedTuple

from ddrecon.march.fused.cellwise import table_rows
from ddrecon.march.fused.layout import Layout


class Case(NamedTuple):
    """What else it is compiled for: whether nodes lie in slices, and which derivatives it finds.

    Those by rays, and by the angles at which they see point lights, which turn with them.
    """

    is_sliced: bool
    varies_rays: bool = False
    varies_angles: bool = False


def layout_constants(layout: Layout, case: Case, has_slopes: bool) -> str:
    """Where in a node the channels of color c are: the first of a kind plus c times its step."""
    numbers = {
        "C": layout.colors,
        "EXTINCTION": layout.extinction,
        "BEAMS": len(layout.beams),
        "MASSES": layout.masses,
        "CHANNELS": layout.channels,
        "OUT": layout.outputs,
        "MASS_STEP": layout.mass_step,
        "FIRST_DIFFUSE": layout.extinction,
        "DIFFUSE_STEP": layout.diffuse_step,
        "FIRST_MASS": layout.first_mass,
        "FIRST_SCATTERING": layout.scattering_from,
        "SCATTERING_STEP": layout.scattering_step,
        "SCATTERING": layout.scattering,
        "FIRST_OWN_SCATTERING": layout.first_scattering,
        "FIRST_PEAK": layout.first_peak,
        "PEAK_STEP": layout.peak_step,
        "PHASES": layout.phases,
        "PHASE_STEP": layout.phase_step,
        "TERMS": layout.terms,
        "CURVES": len(layout.beams) * layout.phases * layout.terms,
        "TABLE_STEP": layout.table_step * table_rows(layout) * layout.terms,
        "CURVE_STEP": layout.curve_step,
        "RAY_TERMS": layout.ray_terms,
        "FIRST_DIFFUSING": layout.diffusing_from,
        "DIFFUSING_STEP": layout.diffusing_step,
        "FIRST_NUMBER": layout.first_number,
        "NUMBER_STEP": layout.number_step,
    }
    answers = {
        "IS_SLICED": case.is_sliced,
        "VARIES_RAYS": case.varies_rays,
        "VARIES_ANGLES": case.varies_angles,
        "HAS_NUMBERS": layout.form is not None,
        "HAS_RUNGS": layout.has_rungs,
        "IS_STEEP": layout.form == "steep",
        "IS_LINEAR": layout.form == "linear",
        "HAS_SLOPES": has_slopes and layout.has_rungs,
        "HAS_PEAK": layout.peak is not None,
        "IS_PEAK_FIELD": bool(layout.peak),
    }
    lines = [f"constexpr int {name} = {number};" for name, number in numbers.items()]
    lines += [f"constexpr bool {name} = {int(answer)};" for name, answer in answers.items()]
    points = ", ".join(str(int(is_point)) for is_point in (*layout.beams, False))
    return "\n" + "\n".join([*lines, f"constexpr int IS_POINT[BEAMS + 1] = {{{points}}};"])
