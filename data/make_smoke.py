"""A small solver of smoke: what `make_capture.py` films.

Incompressible air on a periodic grid (Stam 1999, doi:10.1145/311535.311548): it carries itself and
the smoke along by MacCormack's scheme, rises where smoke is warm, is stirred by vorticity
confinement (Fedkiw, Stam and Jensen 2001, doi:10.1145/383259.383260), and loses its divergence in
Fourier space. Lengths are in cells, times in steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

BUOYANCY = 0.025
"""Rise in speed a step where smoke is 1."""
CONFINEMENT = 0.1
GUSTS = 0.06
"""Speed of the slow gusts from the side at the source."""
FADE = 0.997
"""What is left of smoke, and of its warmth, after a step."""


def simulate(shape: tuple[int, int, int], steps: int, seed: int) -> Iterator[Array]:
    """The density [z, y, x] of smoke, 1 at its source, after each of `steps`; y is up.

    The source is a disk near the bottom, fed unevenly.
    """
    generator = np.random.default_rng(seed)
    velocity = np.zeros((3, *shape), np.float32)
    smoke = np.zeros(shape, np.float32)
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape), indexing="ij")
    middle = [(n - 1) / 2 for n in shape]
    away = np.hypot(z - middle[0], x - middle[2])
    phases = generator.uniform(0, 2 * np.pi, (2, 3))
    for step in range(steps):
        # Feed: a disk whose strength turns about, pushed by gusts.
        turn = np.arctan2(z - middle[0], x - middle[2]) - 0.21 * step
        fed = (away < 0.14 * shape[2]) & (abs(y - 0.08 * shape[1]) < 2)
        smoke[fed] = np.maximum(smoke, 0.75 + 0.25 * np.sin(3 * turn))[fed]
        velocity[1][fed] = 0.6
        for part, axis in enumerate((0, 2)):
            gust = sum(np.sin((0.05 + 0.07 * k) * step + phases[part, k]) for k in range(3))
            velocity[axis][fed] = GUSTS * gust
        # Rise, stir, carry, and lose the divergence.
        velocity[1] += BUOYANCY * smoke
        velocity += _confine(velocity)
        velocity = _project(_carry(velocity, velocity))
        smoke = FADE * _carry(smoke[None], velocity)[0].clip(0, None)
        # Air and smoke do not come round to the other side.
        calm = np.clip((shape[1] - 1 - y) / 6, 0, 1) * np.clip(y / 2, 0, 1)
        velocity, smoke = velocity * calm, smoke * calm
        yield smoke


def _carry(fields: Array, velocity: Array) -> Array:
    """`fields` [n, z, y, x] after a step: MacCormack's scheme (Selle et al. 2008), held within the
    values that it goes between.
    """
    forward, low, high = _sample(fields, -velocity)
    back, _, _ = _sample(forward, velocity)
    better, _, _ = _sample(fields + 0.5 * (fields - back), -velocity)
    return np.clip(better, low, high)


def _sample(fields: Array, shift: Array) -> tuple[Array, Array, Array]:
    """`fields` at every cell's place moved by `shift` [3, z, y, x], trilinearly, and the least and
    largest of the eight values around.
    """
    shape = fields.shape[1:]
    places = [
        np.arange(n, dtype=np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
        + shift[axis]
        for axis, n in enumerate(shape)
    ]
    first = [np.floor(place).astype(np.int32) for place in places]
    rest = [place - corner for place, corner in zip(places, first, strict=True)]
    total = np.zeros_like(fields)
    low, high = np.full_like(fields, np.inf), np.full_like(fields, -np.inf)
    for corner in np.ndindex(2, 2, 2):
        index = tuple((f + c) % n for f, c, n in zip(first, corner, shape, strict=True))
        weight = np.prod([r if c else 1 - r for r, c in zip(rest, corner, strict=True)], axis=0)
        values = fields[(slice(None), *index)]
        total += weight * values
        low, high = np.minimum(low, values), np.maximum(high, values)
    return total, low, high


def _confine(velocity: Array) -> Array:
    """The change of `velocity` that gives whirls back what the grid takes from them."""

    def slope(field: Array, axis: int) -> Array:
        return 0.5 * (np.roll(field, -1, axis) - np.roll(field, 1, axis))

    w, v, u = velocity
    curl = np.stack(
        [slope(v, 2) - slope(u, 1), slope(u, 0) - slope(w, 2), slope(w, 1) - slope(v, 0)]
    )  # along z, y, x
    strength = np.sqrt((curl**2).sum(0))
    uphill = np.stack([slope(strength, axis) for axis in range(3)])
    uphill /= np.sqrt((uphill**2).sum(0)) + 1e-6
    (nz, ny, nx), (cz, cy, cx) = uphill, curl
    return CONFINEMENT * np.stack([nx * cy - ny * cx, nz * cx - nx * cz, ny * cz - nz * cy])


def _project(velocity: Array) -> Array:
    """`velocity` without its divergence, on a periodic grid."""
    lines = [2 * np.pi * np.fft.fftfreq(n) for n in velocity.shape[1:]]
    lines[2] = 2 * np.pi * np.fft.rfftfreq(velocity.shape[3])
    waves = np.stack(np.meshgrid(*lines, indexing="ij"))
    square = (waves**2).sum(0)
    square[0, 0, 0] = 1
    spectrum = np.fft.rfftn(velocity, axes=(1, 2, 3))
    spectrum -= waves * ((waves * spectrum).sum(0) / square)
    return np.fft.irfftn(spectrum, velocity.shape[1:], axes=(1, 2, 3)).astype(np.float32)
