"""What data/make_shapes.py computes: closed surfaces filled, shapes folded without gaining or
losing volume.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

spec = importlib.util.spec_from_file_location(
    "make_shapes", Path(__file__).parents[2] / "data" / "make_shapes.py"
)
assert spec is not None and spec.loader is not None
shapes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(shapes)


def octahedron(radius: float) -> np.ndarray:
    """Triangles of the octahedron |x| + |y| + |z| = radius, turned so that no edge is along an axis."""
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    signs = [(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1)]
    faces = [np.diag(sign)[:: 1 if np.prod(sign) > 0 else -1] for sign in signs]
    return radius * np.array(faces) @ turn.T


def test_a_closed_surface_is_filled() -> None:
    radius, cells = 0.4, 60
    points = shapes.centers(shapes.CUBE, (cells,) * 3)
    filled = shapes.inside(octahedron(radius), points)
    assert filled.mean() == pytest.approx(4 / 3 * radius**3, rel=0.02)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    assert (filled == (np.abs(points @ turn).sum(-1) < radius)).all()


def test_a_hole_in_a_shape_stays_empty() -> None:
    points = shapes.centers(shapes.CUBE, (40,) * 3)
    both = np.concatenate([octahedron(0.4), octahedron(0.2)[:, ::-1]])
    assert (
        shapes.inside(both, points)
        == shapes.inside(octahedron(0.4), points) & ~shapes.inside(octahedron(0.2), points)
    ).all()


def test_curl_noise_has_no_divergence() -> None:
    points, step = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3)), 1e-5
    sides = [
        [shapes.swirled(points + sign * step * axis, 3, 1e-3) for sign in (1, -1)]
        for axis in np.eye(3)
    ]
    jacobian = np.stack([(ahead - behind) / (2 * step) for ahead, behind in sides], -1)
    assert np.linalg.det(jacobian) == pytest.approx(1, abs=3e-5)
    assert np.abs(jacobian - np.eye(3)).max() > 1e-3
