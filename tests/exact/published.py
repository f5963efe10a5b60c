"""Layers without end sideways and a cloud, as scenes and by independent means.

A layer lies between z = -depth and 0 in equal cells, under a sun of irradiance pi; optical depths
are lengths. `R` is its reflectance, `T` its transmittance with light that is not scattered, `up`
and `down` are pi I / (mu0 pi) at `VIEWS` above and below. Ambartsumian's H, discrete ordinates
(PythonicDISORT) and, of the cloud, the consensus of many codes say what is right.
"""

import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from ddrecon.io.volumes.table import write_field
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.validate.balance import find_balance

Array = NDArray[np.float64]
Seen = dict[str, Array]
"""By `R`, `T`, `up` and `down`; a half-space has no `T` and no `down`."""
VIEWS = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Cosines of views with the normal, in a plane across the sun's."""


def _gauss(count: int) -> tuple[Array, Array]:
    """Nodes and weights on cosines from 0 to 1."""
    nodes, weights = leggauss(count)
    return (nodes + 1) / 2, weights / 2


NODES, WEIGHTS = _gauss(96)
FLUX_NODES, FLUX_WEIGHTS = _gauss(16)
"""Where our radiance is integrated to a flux: where azimuths are alike, these are enough."""
PHASES: dict[str, dict[str, Any]] = {
    "isotropic": {"type": "henyey_greenstein", "g": 0.0},
    "Rayleigh": {"type": "rayleigh"},
    "g 0.75": {"type": "henyey_greenstein", "g": 0.75},
    "backward": {"type": "henyey_greenstein", "g": -0.7},
    "haze": {"type": "two_lobe", "g": [0.824, -0.55], "weight": 0.9724},
}
"""As in a scene file."""
DEEP = 5.0
"""How many diffusion lengths of a half-space there are in its scene."""


@dataclass(frozen=True)
class Layer:
    """A layer of optical depth `depth`, a half-space where that is infinite.

    `phase` as in a scene file; `sun`: cosine of the sun with the normal; `cell`: depth of a cell.
    With `across` 0 it is one column, a million times as wide as deep. Else the cells are cubes,
    `across` optical depths of them, which may repeat along `periodic` axes.
    """

    albedo: float
    phase: dict[str, Any] = field(default_factory=lambda: PHASES["isotropic"])
    depth: float = math.inf
    sun: float = 1.0
    cell: float = 0.25
    across: float = 0.0
    periodic: str = ""

    @property
    def shown_depth(self) -> float:
        """The depth of its scene, a whole number of cells."""
        if self.depth < math.inf:
            return self.depth
        decay = math.sqrt(3 * (1 - self.albedo) * (1 - self.albedo * self.moments(2)[1]))
        return self.cell * math.ceil(DEEP / decay / self.cell)

    def moments(self, count: int) -> Array:
        """Legendre moments of its phase function."""
        degrees = np.arange(count)
        match self.phase["type"]:
            case "rayleigh":
                return np.where(degrees == 2, 0.1, degrees == 0)
            case "two_lobe":
                (one, other), weight = self.phase["g"], self.phase["weight"]
                return weight * one**degrees + (1 - weight) * other**degrees
        return np.asarray(self.phase["g"] ** degrees, float)

    @property
    def volume(self) -> dict[str, Any]:
        """The volume of its scene."""
        depth, layers = self.shown_depth, round(self.shown_depth / self.cell)
        columns = max(round(self.across / self.cell), 1)
        half = self.across / 2 or 5e5 * depth
        box = {"min": [-half, -half, -depth], "max": [half, half, 0.0]}
        cells = {"bounds": box, "resolution": [columns, columns, layers], "density": 1.0}
        cells["periodic"] = list(self.periodic)
        return cells | {"sigma_t": 1.0, "albedo": self.albedo, "phase": self.phase}

    def balance(self) -> Seen:
        """Its reflectance `R` and transmittance `T` by the energy balance, and `A`, the rest."""
        camera = _camera([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], 1e-3, 1)
        with loaded(_scene(self.volume, self.sun, [camera])) as scene:
            parts = find_balance(scene)["fractions"]
        leaves = parts["leaves"]
        return {"R": leaves["+z"], "T": leaves["-z"], "A": parts["absorbed"]}

    def seen(self, overrides: Sequence[str] = ()) -> Seen:
        """What ddrecon makes of it."""
        depth = self.shown_depth
        sides = [(1, 0.0, "R", "up"), (-1, -depth, "T", "down")]
        sides = sides[: 1 if self.depth == math.inf else 2]
        cameras = [
            _camera([0.0, math.sqrt(1 - cosine**2), side * cosine], [0.0, 0.0, height], 1e-3, 1)
            for side, height, *_ in sides
            for cosine in (*FLUX_NODES.tolist(), *VIEWS.tolist())
        ]
        radiance = show(_scene(self.volume, self.sun, cameras), overrides) / self.sun
        found: Seen = {}
        parts = np.split(radiance, len(sides))
        for (_, height, flux, views), part in zip(sides, parts, strict=True):
            at_nodes, found[views] = np.split(part.flatten(), [len(FLUX_NODES)])
            direct = math.exp(height / self.sun) if flux == "T" else 0.0
            found[flux] = 2 * (FLUX_WEIGHTS * FLUX_NODES * at_nodes).sum() + direct
        return found

    def truth(self) -> Seen:
        """By H where that is known, else by ordinates."""
        if self.depth == math.inf and not self.moments(3)[1:].any():
            return h_reflection(self.albedo, self.sun)
        return ordinates(self)


@dataclass(frozen=True)
class StepCloud:
    """I3RC's step cloud: optical depths 2 and 18 in turn, each 0.25 km wide and thick, g 0.85.

    It repeats along x, does not vary along y, and is seen from the zenith, in `columns` cells a
    period and half as many layers. Cahalan et al. 2005, doi:10.1175/BAMS-86-9-1275, case 1.
    """

    name: str
    albedo: float
    sun: float
    columns: int = 32

    def seen(self, overrides: Sequence[str] = ()) -> Seen:
        """pi I / (F mu0) above each of 32 columns, `up`."""
        columns = np.repeat([8.0, 72.0], self.columns // 2)
        corners = np.array([[0.0, 0.0, 0.0], [0.5, 0.5 / self.columns, 0.25]])
        camera = _camera([0.0, 0.0, 1.0], [0.25, 0.0, 0.25], 0.5, 128)
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "cloud.npz"
            density = np.broadcast_to(columns, (self.columns // 2, 1, len(columns)))
            write_field(path, "density", density, corners)
            low, high = corners.tolist()
            volume = {"bounds": {"min": low, "max": high}, "density": {"file": str(path)}}
            volume |= {"periodic": ["x", "y"]}
            medium = {"sigma_t": 1.0, "albedo": self.albedo, "g": 0.85}
            images = show(_scene(volume | medium, self.sun, [camera]), overrides)
        return {"up": images.reshape(32, -1).mean(1) / self.sun}

    def truth(self) -> Seen:
        """That of the consensus."""
        rows = Path(__file__).with_name("step_cloud.csv").read_text().splitlines()
        table = {name: numbers for name, *numbers in (row.split(",") for row in rows)}
        return {"up": np.array(table[self.name], float)}


def _camera(side: list[float], target: list[float], width: float, pixels: int) -> dict[str, Any]:
    """A row of pixels of parallel rays, `width` wide, that look from `side` of `target`."""
    origin = [there + part for there, part in zip(target, side, strict=True)]
    pose = {"origin": origin, "target": target, "up": [0, 1, 0]}
    return pose | {"type": "orthographic", "width": width, "resolution": [pixels, 1]}


def _scene(volume: dict[str, Any], sun: float, cameras: list[dict[str, Any]]) -> dict[str, Any]:
    """A scene file of `volume`, lit at cosine `sun` by irradiance pi that travels towards +x."""
    travel = [math.sqrt(1 - sun**2), 0.0, -sun]
    views = [{"name": f"view{number}", "camera": camera} for number, camera in enumerate(cameras)]
    light = {"type": "directional", "direction": travel, "irradiance": math.pi}
    return {"volume": volume, "lights": [light], "views": views}


def show(scene: dict[str, Any], overrides: Sequence[str] = ()) -> Array:
    """Gray images [views, h, w] of a scene file."""
    with loaded(scene, overrides) as world, torch.no_grad():
        return render(world).mean(1).double().numpy()


@contextmanager
def loaded(scene: dict[str, Any], overrides: Sequence[str] = ()) -> Iterator[Scene]:
    """A scene file as tensors."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "scene.yaml"
        path.write_text(json.dumps(scene))
        yield load_scene(path, overrides=overrides)


@cache
def h_at_nodes(albedo: float) -> Array:
    """Ambartsumian's H: 1 / H(mu) = sqrt(1 - w) + w / 2 int mu' H(mu') / (mu + mu') dmu'."""
    values = np.ones_like(NODES)
    for _ in range(50):
        values = (values + h_function(albedo, NODES, values)) / 2
    return values


def h_function(albedo: float, cosines: Array, at_nodes: Array | None = None) -> Array:
    """H at `cosines`, of what it is `at_nodes`."""
    at_nodes = h_at_nodes(albedo) if at_nodes is None else at_nodes
    integrand = WEIGHTS * NODES * at_nodes / (np.asarray(cosines)[..., None] + NODES)
    return 1 / (math.sqrt(1 - albedo) + albedo / 2 * integrand.sum(-1))


def h_reflection(albedo: float, sun: float) -> Seen:
    """A half-space that scatters isotropically: R(mu) = w / 4 / (mu + mu0) H(mu) H(mu0)."""
    h_sun = h_function(albedo, np.array(sun))
    up = albedo / 4 / (VIEWS + sun) * h_function(albedo, VIEWS) * h_sun
    return {"R": 1 - h_sun * math.sqrt(1 - albedo), "up": up}


def ordinates(layer: Layer, views: Array = VIEWS) -> Seen:
    """A layer by 64 ordinates, as PythonicDISORT solves them, seen at cosines `views`."""
    from PythonicDISORT.pydisort import pydisort
    from PythonicDISORT.subroutines import interpolate

    streams, depth = 64, min(layer.depth, 10 * layer.shown_depth)
    moments = layer.moments(4 * streams)
    solved = pydisort(
        depth, layer.albedo, streams, moments, layer.sun, 1.0, 0.0,
        NLeg=streams, f_arr=moments[streams], NT_cor=True,
    )  # fmt: skip
    up, down, radiance = solved[1], solved[2], interpolate(solved[4], NT_cor=True)
    scale = math.pi / layer.sun
    found = {"R": up(0.0) / layer.sun, "up": scale * radiance(views, 0.0, math.pi / 2)}
    if layer.depth < math.inf:
        found["T"] = sum(down(depth)) / layer.sun
        found["down"] = scale * radiance(-views, depth, math.pi / 2)
    return found


def percent_off(found: Array, wanted: Array) -> float:
    """The relative error of a number, with its sign, and the relative RMS error of several."""
    if np.ndim(wanted) == 0:
        return float(100 * (found / wanted - 1))
    return float(100 * np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
