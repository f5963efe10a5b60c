"""`ddrecon check` says what a scene is and what physics it needs, and writes nothing."""

import gc
import json
import re
import weakref

import pytest
import torch
from small_scene import contents

from ddrecon import load_scene
from ddrecon.cli.check import supports_of


def test_grid_views_physics_memory_and_time(succeed, folder):
    before = contents(folder)
    lines = succeed("check", "scene.yaml").stdout.splitlines()
    assert lines[0].startswith("grid: 6 x 5 x 4 cells of 0.1667 x 0.2 x 0.25")
    views = ["  front: perspective, 8 x 6 pixels, train", "  side: perspective, 8 x 6 pixels, test"]
    assert {"views: 2", "physics:", "optimizes: density (120 numbers)"} <= set(lines)
    assert {f"{view}, with image" for view in views} <= set(lines)
    assert lines[-2].startswith("memory: about ") and "MiB" in lines[-2]
    assert lines[-1].startswith("time: about ") and "at most 1 minutes for 4" in lines[-1]
    bare = [f"-D{key}=null" for key in ("optimize", "views.0.image", "views.1.image")]
    lines = succeed("check", "scene.yaml", *bare).stdout.splitlines()
    assert {"optimizes: nothing", *views} <= set(lines) and lines[-1].startswith("memory:")
    assert "optimizes: density" in succeed("check", "scene.yaml", *bare[1:]).stdout
    report = json.loads(succeed("check", "scene.yaml", "--json").stdout)
    assert report["resolution"] == [6, 5, 4] and report["bounds"] == [[-0.5] * 3, [0.5] * 3]
    keys = "name", "width", "height", "split"
    views = [tuple(view[key] for key in keys) for view in report["views"]]
    assert views == [("front", 8, 6, "train"), ("side", 8, 6, "test")]
    assert report["optimizes"] == {"density": 120} and report["memory_bytes"] > 0
    assert contents(folder) == before


LIMITED = "flux_limited diffusion, damped Picard iteration with multigrid"
SUN = "lights=[{type: directional, direction: [0, -1, 0], irradiance: 1}]"
LAMP = "lights=[{type: point, position: [0, 2, 0], intensity: 1}]"
PHYSICS = [
    ("volume.g=0.3", "fluxes Q1 and L1 (g is not 0)", "no fluxes"),
    ("volume.g=0.5", "angles to degree 3: 16 moments of light (g is not 0)", "no fluxes"),
    ("volume.g=-0.8", "beams in pairs: a backward peak turns 0.262 of", "delta-Eddington"),
    ("volume.g=0", "no fluxes Q1 and L1 (g = 0)", "delta-Eddington"),
    ("diffusion.scheme=printed", "printed scheme by Jacobi", "multigrid"),
    ("diffusion.model=flux_limited", LIMITED, "closure"),
    ("diffusion.model=none", "no multiple scattering", "p1 diffusion"),
    ("volume.sigma_s=0", "no multiple scattering", "p1 diffusion"),
    ("lights=[{type: ambient, radiance: 1}]", "ambient light", "directional"),
    (SUN, "1 directional light", "ambient"),
    (LAMP, "towards 1 point light", "directional"),
    ("volume.sigma_s=2", "1 color channel", "3 color channels"),
]


@pytest.mark.parametrize(("override", "present", "absent"), PHYSICS)
def test_only_the_physics_a_scene_needs(succeed, override, present, absent):
    changes = "diffusion.transport_rounds=null", "optimize=null", "volume.density=0", override
    overrides = [word for change in changes for word in ("-D", change)]
    result = succeed("check", "scene.yaml", "--json", *overrides)
    physics = "\n".join(json.loads(result.stdout)["physics"])
    assert present in physics and absent not in physics


def test_every_command_tells_the_same_doubts(succeed):
    """Each once, on stderr, whatever is printed."""
    thick = "-D", "volume.sigma_s=300", "-D", "optimize.parameters.density.init=1"
    succeed("optimize", "scene.yaml", "-o", "run", *thick)
    (told,) = re.findall("warning: .*", succeed("check", "scene.yaml", *thick).stderr)
    assert "cells at the faces of the box" in told
    for command in (
        ["render", "scene.yaml", "-o", "out", *thick],
        ["export", "scene.yaml", "-o", "scene.vdb", *thick],
        ["uncertainty", "run", "-o", "sure", "--calibrate", "1"],
    ):
        assert succeed(*command).stderr.splitlines().count(told) == 1


def test_no_pictures_of_a_film_are_kept_but_the_first(folder):
    """But what they show."""
    pictures = list[weakref.ref[torch.Tensor]]()

    def frames():
        for _ in range(3):
            scene = load_scene(folder / "scene.yaml")
            pictures.extend(weakref.ref(v.image) for v in scene.views if v.image is not None)
            yield scene

    supports = supports_of(frames())
    gc.collect()
    assert len(supports) == 3 and all(support.shown[0].any() for support in supports)
    alive = [picture() is not None for picture in pictures]
    assert len(alive) == 6 and sum(alive[:2]) == 1 and not any(alive[2:])
