"""Our default settings against what is published of layers without end and of a cloud."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from published import PHASES, Layer, StepCloud, h_function, h_reflection, ordinates, percent_off

SLAB = Layer(0.9, PHASES["g 0.75"], 2.0, across=32.0)
VAN_DE_HULST = {
    "R": np.array(0.09739),
    "T": np.array(0.66096),
    "up": np.array([0.13304, 0.13856, 0.11956, 0.09411, 0.07132]),
    "down": np.array([0.16486, 0.22473, 0.27785, 0.36889, 0.72155]),
}
"""`SLAB` in van de Hulst's Multiple Light Scattering, 1980."""

# What is claimed of our defaults, in percent.
HALF_SPACE = {"R": 0.3, "up": 1.0}
VAN_DE_HULST_SLAB = {"R": 1.0, "up": 2.0, "T": 0.5, "down": 1.0}
SLABS = {
    ("Rayleigh", 1.0): {"R": 0.6, "up": 1.5, "T": 0.4, "down": 1.0},
    ("Rayleigh", 8.0): {"R": 0.6, "up": 1.5, "T": 1.5, "down": 2.0},
    ("g 0.75", 1.0): {"R": 0.7, "up": 2.5, "T": 0.2, "down": 1.0},
    ("g 0.75", 8.0): {"R": 0.9, "up": 2.0, "T": 1.2, "down": 1.5},
    ("haze", 1.0): {"R": 0.5, "up": 3.0, "T": 0.2, "down": 0.8},
    ("haze", 8.0): {"R": 1.3, "up": 2.0, "T": 0.5, "down": 1.0},
    ("backward", 1.0): {"R": 0.2, "up": 0.9, "T": 0.3, "down": 1.6},
    ("backward", 8.0): {"R": 0.5, "up": 2.4, "T": 0.3, "down": 2.0},
}
"""By phase function and depth; albedo 0.9, cells of 0.25 and 0.5 optical depths."""
CLOUDS = {
    StepCloud("overhead", 0.999999, 1.0): 4.0,
    StepCloud("slanted", 0.999999, 0.5): 5.0,
    StepCloud("absorbing", 0.99, 0.5): 5.0,
}


def assert_within(percent, found, truth):
    off = {key: percent_off(found[key], truth[key]) for key in truth}
    assert all(abs(off[key]) < percent[key] for key in truth), off


@pytest.fixture
def _has_ordinates():
    pytest.importorskip("PythonicDISORT", reason="discrete ordinates are an extra (`dev`)")


def test_h_of_a_medium_that_absorbs_nothing_is_the_tabulated_one():
    found = h_function(1.0, np.array([0.0, 0.1, 0.5, 1.0]))
    assert found == pytest.approx([1.0, 1.2474, 2.0128, 2.9078], abs=1e-4)


@pytest.mark.usefixtures("_has_ordinates")
def test_ordinates_are_van_de_hulsts_and_ambartsumians():
    half_spaces = [(Layer(0.9, sun=sun), h_reflection(0.9, sun)) for sun in (1.0, 0.5)]
    for layer, wanted in [(SLAB, VAN_DE_HULST), *half_spaces]:
        found = ordinates(layer)
        assert all(found[key] == pytest.approx(wanted[key], abs=6e-6) for key in wanted)


@pytest.mark.slow
@pytest.mark.parametrize("sun", [1.0, 0.5])
@pytest.mark.parametrize("albedo", [0.5, 0.9, 0.99, 0.999])
def test_half_spaces_are_ambartsumians(albedo, sun):
    assert_within(HALF_SPACE, Layer(albedo, sun=sun).seen(), h_reflection(albedo, sun))


@pytest.mark.parametrize(
    ("layer", "truth"),
    [
        (replace(SLAB, across=0.0), VAN_DE_HULST),
        (replace(SLAB, across=1.0, periodic="xy"), VAN_DE_HULST),
        *((Layer(albedo), h_reflection(albedo, 1.0)) for albedo in (0.5, 0.9, 0.99)),
        (Layer(0.9, sun=0.5), h_reflection(0.9, 0.5)),
    ],
    ids=["slab", "periodic", "albedo 0.5", "0.9", "0.99", "slanted"],
)
def test_balances_are_those_of_slabs_and_half_spaces(layer, truth):
    """Within 1 %, or 0.2 % of what enters."""
    found = layer.balance()
    for key in truth.keys() & {"R", "T"}:
        assert found[key] == pytest.approx(float(truth[key]), rel=0.01, abs=2e-3)
    if "T" in truth:
        assert found["A"] == pytest.approx(float(1 - truth["R"] - truth["T"]), rel=0.01)


@pytest.mark.slow
def test_slab_is_van_de_hulsts():
    assert_within(VAN_DE_HULST_SLAB, SLAB.seen(), VAN_DE_HULST)


@pytest.mark.slow
@pytest.mark.usefixtures("_has_ordinates")
@pytest.mark.parametrize(("name", "depth"), SLABS)
def test_slabs_are_those_of_discrete_ordinates(name, depth):
    # One in a box with sides, which takes long; the others repeat.
    has_sides = (name, depth) == ("g 0.75", 1.0)
    sides: dict[str, Any] = {"across": 32.0} if has_sides else {"across": 1.0, "periodic": "xy"}
    layer = Layer(0.9, PHASES[name], depth, cell=min(depth / 4, 0.5), **sides)
    assert_within(SLABS[name, depth], layer.seen(), ordinates(layer))


@pytest.mark.slow
@pytest.mark.parametrize("cloud", CLOUDS, ids=lambda cloud: cloud.name)
def test_step_cloud_is_the_consensus_of_many_codes(cloud):
    assert_within({"up": CLOUDS[cloud]}, cloud.seen(), cloud.truth())
