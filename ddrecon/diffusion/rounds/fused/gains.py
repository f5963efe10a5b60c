"""What a sweep changed, and what of it is a source to diffusion, in one pass over the cells (E12).

The files of kernels have no postponed annotations: Warp reads the types of arguments.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.kernels.native import number_type, program

# Pointers to `size` cells of a color; those of moments that light has not, stay unused.
_COLORS = """
for (int color = 0; color < given.colors; ++color) {
    const long long at = color * given.cells + begin, at_flux = HAS_FLUX ? at : 0;
    const F scale = given.numbers.data[color], strength = given.numbers.data[given.colors + color];
    const F* extinction = given.extinction.data + (given.extinction_channels > 1 ? at : begin);
    const F* scattering = given.scattering.data + (given.scattering_channels > 1 ? at : begin);
    const F* imbalance = given.imbalance.data + (HAS_IMBALANCE ? at : 0);
    const F* swept = given.swept.mean.data + at;
    const F* swept_z = given.swept.z.data + at_flux;
    const F* swept_y = given.swept.y.data + at_flux;
    const F* swept_x = given.swept.x.data + at_flux;
    const F* diffuse = given.diffuse.mean.data + at;
    const F* diffuse_z = given.diffuse.z.data + at_flux;
    const F* diffuse_y = given.diffuse.y.data + at_flux;
    const F* diffuse_x = given.diffuse.x.data + at_flux;
"""
# theta of E14 at a cell, from the depth d of a step: rho = d (psi / phi - 1/2)
_SHARE = """
        const F e = extinction[i], thickness = given.length * scale * e;
        const bool is_empty = thickness < given.least;
        const F depth = is_empty ? given.least : thickness;
        const bool is_thin = depth < F(0.5);
        const F series = psi_series(is_thin ? depth : F(0));
        const F inverse = F(1) / (is_thin ? F(0.5) : depth);
        const F phi = is_thin ? F(1) - depth * series : (F(1) - decay(depth)) * inverse;
        const F psi = is_thin ? series : (F(1) - phi) * inverse;
        const F inverse_phi = F(1) / phi, rho = depth * (psi * inverse_phi - F(0.5));
        const F share = F(1) / (F(1) + rho * rho);
        const F s = SHARES_FIELD ? e : scattering[i], change = swept[i] - diffuse[i];
"""
_GAIN = (
    _COLORS
    + """
    F* gain = found.gain.mean.data + at;
    F* gain_z = found.gain.z.data + at_flux;
    F* gain_y = found.gain.y.data + at_flux;
    F* gain_x = found.gain.x.data + at_flux;
    F* source = found.source.data + at;
    INDEPENDENT
    for (int i = 0; i < size; ++i) {"""
    + _SHARE
    + """
        gain[i] = share * change;
        if (HAS_FLUX) {
            gain_z[i] = share * (swept_z[i] - diffuse_z[i]);
            gain_y[i] = share * (swept_y[i] - diffuse_y[i]);
            gain_x[i] = share * (swept_x[i] - diffuse_x[i]);
        }
        source[i] = share * (strength * s * change - (HAS_IMBALANCE ? imbalance[i] : F(0)));
    }
}
"""
)
# The order of sums of numbers is free, or else they would not become vector code.
_ADJOINT = (
    _COLORS.replace("{", "{\n#if defined(__clang__)\n#pragma clang fp reassociate(on)\n#endif", 1)
    + """
    const F* gain_bar = bars.gain.mean.data + at;
    const F* gain_z_bar = bars.gain.z.data + at_flux;
    const F* gain_y_bar = bars.gain.y.data + at_flux;
    const F* gain_x_bar = bars.gain.x.data + at_flux;
    const F* source_bar = bars.source.data + at;
    F* swept_bar = found.swept.mean.data + at;
    F* swept_z_bar = found.swept.z.data + at_flux;
    F* swept_y_bar = found.swept.y.data + at_flux;
    F* swept_x_bar = found.swept.x.data + at_flux;
    F* diffuse_bar = found.diffuse.mean.data + at;
    F* diffuse_z_bar = found.diffuse.z.data + at_flux;
    F* diffuse_y_bar = found.diffuse.y.data + at_flux;
    F* diffuse_x_bar = found.diffuse.x.data + at_flux;
    F* imbalance_bar = found.imbalance.data + (HAS_IMBALANCE ? at : 0);
    F* e_bar = found.extinction.data + (given.extinction_channels > 1 ? at : begin);
    F* s_bar = found.scattering.data + (given.scattering_channels > 1 ? at : begin);
    double scale_bar = 0, strength_bar = 0;
    INDEPENDENT
    for (int i = 0; i < size; ++i) {"""
    + _SHARE
    + """
        // by the gains, of which the mean's is scattered into the source
        const F mean_bar = gain_bar[i] + strength * s * source_bar[i];
        swept_bar[i] = share * mean_bar;
        diffuse_bar[i] = -share * mean_bar;
        F share_bar = mean_bar * change;
        if (HAS_FLUX) {
            share_bar += gain_z_bar[i] * (swept_z[i] - diffuse_z[i]);
            share_bar += gain_y_bar[i] * (swept_y[i] - diffuse_y[i]);
            share_bar += gain_x_bar[i] * (swept_x[i] - diffuse_x[i]);
            swept_z_bar[i] = share * gain_z_bar[i];
            swept_y_bar[i] = share * gain_y_bar[i];
            swept_x_bar[i] = share * gain_x_bar[i];
            diffuse_z_bar[i] = -share * gain_z_bar[i];
            diffuse_y_bar[i] = -share * gain_y_bar[i];
            diffuse_x_bar[i] = -share * gain_x_bar[i];
        }
        if (HAS_IMBALANCE) {
            share_bar -= source_bar[i] * imbalance[i];
            imbalance_bar[i] = -share * source_bar[i];
        }
        // by theta, through d: rho' = (phi - psi) / phi^2 - 1/2; none where cells are empty
        const F rho_slope = (phi - psi) * inverse_phi * inverse_phi - F(0.5);
        const F depth_bar
            = is_empty ? F(0) : F(-2) * share_bar * share * share * rho * rho_slope * given.length;
        const F scattering_bar = source_bar[i] * share * change;
        e_bar[i] += depth_bar * scale + (SHARES_FIELD ? scattering_bar * strength : F(0));
        if (!SHARES_FIELD) s_bar[i] += scattering_bar * strength;
        scale_bar += (double)(depth_bar * e);
        strength_bar += (double)(scattering_bar * s);
    }
    found.numbers.data[2 * given.colors * item + color] = scale_bar;
    found.numbers.data[2 * given.colors * item + given.colors + color] = strength_bar;
}
"""
)


@functools.cache
def gain_records(bits: int) -> SimpleNamespace:
    """The records `Light`, `Given`, `Found` and `Bars` of numbers of so many `bits`."""
    F: Any = number_type(bits)

    @wp.struct
    class Light:
        """Two moments [C, z, y, x], or their cotangents."""

        mean: wp.array(dtype=F)
        z: wp.array(dtype=F)
        y: wp.array(dtype=F)
        x: wp.array(dtype=F)

    @wp.struct
    class Given:
        """What gains are of, all arrays flat: moments and `imbalance` [C, z, y, x].

        Fields [K, z, y, x]; `numbers` [2, C]: their scales; `length`: the mean step [u]; `least`:
        the depth of empty cells.
        """

        swept: Light
        diffuse: Light
        imbalance: wp.array(dtype=F)
        extinction: wp.array(dtype=F)
        scattering: wp.array(dtype=F)
        numbers: wp.array(dtype=F)
        length: F
        least: F
        cells: int
        colors: int
        extinction_channels: int
        scattering_channels: int

    @wp.struct
    class Found:
        """Gains and source, or their cotangents."""

        gain: Light
        source: wp.array(dtype=F)

    @wp.struct
    class Bars:
        """Cotangents of what is given; those of `numbers` by item [items, 2, C]."""

        swept: Light
        diffuse: Light
        imbalance: wp.array(dtype=F)
        extinction: wp.array(dtype=F)
        scattering: wp.array(dtype=F)
        numbers: wp.array(dtype=wp.float64)

    return SimpleNamespace(Light=Light, Given=Given, Found=Found, Bars=Bars)


@functools.cache
def gain_kernels(
    bits: int, has_flux: bool, shares_field: bool, has_imbalance: bool
) -> SimpleNamespace:
    """The kernels `gain` and `transpose`, of which an item is `size` cells in all colors."""
    types = gain_records(bits)
    Given, Found, Bars = types.Given, types.Found, types.Bars
    known = {"HAS_FLUX": has_flux, "SHARES_FIELD": shares_field, "HAS_IMBALANCE": has_imbalance}
    constants = "".join(f"const bool {k} = {str(v).lower()};\n" for k, v in known.items())

    @wp.func_native(program(bits, constants + _GAIN))
    def gain_cells(given: Given, found: Found, begin: int, size: int): ...

    @wp.func_native(program(bits, constants + _ADJOINT))
    def transpose_cells(
        given: Given, bars: Found, found: Bars, item: int, begin: int, size: int
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def gain(first: int, given: Given, found: Found, size: int):
        gain_cells(given, found, (first + wp.tid()) * size, size)

    @wp.kernel(enable_backward=False, module="unique")
    def transpose(first: int, given: Given, bars: Found, found: Bars, size: int):
        item = first + wp.tid()
        transpose_cells(given, bars, found, item, item * size, size)

    return SimpleNamespace(gain=gain, transpose=transpose)
