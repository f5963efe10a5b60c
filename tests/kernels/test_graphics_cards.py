"""Kernels of iterations are such as a graphics card runs well: compiled without one."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("warp", reason="Warp is not installed (extra `fast`)")
import warp
from as_on_a_gpu import as_on_a_gpu, headers_of
from graphics_cards import ARCHITECTURES, find_resources

from ddrecon.engine import use_engine
from ddrecon.kernels.text import MOST_REGISTERS
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene

CONFIGS = Path(__file__).parents[2] / "configs"
MOST_STACK = 1024
"""Bytes of a thread: what has no room in its registers as well."""


@pytest.mark.slow
def test_kernels_of_iterations_fit_into_registers(tmp_path, monkeypatch):
    """Those that follow light through cells; others keep nothing on a stack.

    Of a plume, and where cameras and lamps are sought as well; each for one generation.
    """
    use_engine("warp")
    kernels = dict[Any, None]()
    for name in ("plume", "capture"):
        scene = load_scene(CONFIGS / f"{name}.yaml")
        factor = max(scene.volume.grid.shape) // 8
        with as_on_a_gpu() as launched:
            Reconstruction(scene_at_level(scene, factor)).step()
        kernels |= dict.fromkeys(one for one in launched if any(map(follows, headers_of([one]))))
    monkeypatch.setattr(warp.config, "optimization_level", None)  # as users have them
    for index, kernel in enumerate(kernels):
        architecture = ARCHITECTURES[index % len(ARCHITECTURES)]
        registers, stack = find_resources(kernel, architecture, tmp_path)
        assert 0 < registers <= MOST_REGISTERS, (kernel.key, architecture, registers)
        assert stack <= MOST_STACK, (kernel.key, architecture, stack)
    assert index > 15


def follows(header):
    """Whether kernels of the `header` follow light."""
    return header.startswith(("light/", "march/", "transport/"))
