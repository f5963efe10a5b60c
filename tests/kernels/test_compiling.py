"""Adjoints are compiled beside what is done before them: each kernel once, and none in vain."""

import threading
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("warp")

from ddrecon.engine import use_engine
from ddrecon.kernels import compiling
from ddrecon.kernels import launch as launching
from ddrecon.kernels.text import TextKernel
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"
SMALL = ["volume.resolution=[10,12,8]", "volume.g=0.3"]
LAMP = "lights=[{type: point, position: [0, 2, 0], intensity: 1}]"


@pytest.fixture
def nothing_loaded(monkeypatch):
    """A process that has no kernels, and two threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    monkeypatch.setattr(compiling, "_loaded", set())
    monkeypatch.setattr(compiling, "_named", {})
    monkeypatch.setattr(compiling, "_waiting", [])
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [SMALL, [*SMALL, LAMP, "optimize.parameters={density: {}, sigma_s: {}}"]]
)
def test_an_iteration_names_the_adjoints_that_it_launches(nothing_loaded, monkeypatch, change):
    use_engine("warp")
    launched = dict[Any, bool]()
    load = compiling.load

    def note(kernel, device):
        launched.setdefault(kernel, (kernel, device) in compiling._named)
        load(kernel, device)

    monkeypatch.setattr(launching, "load", note)
    Reconstruction(load_scene(BALL, overrides=change)).step()
    named = {kernel.key for kernel, was_named in launched.items() if was_named}
    assert {kernel for kernel, _ in compiling._named} <= launched.keys()
    assert {"ordinates_back", "transpose", "flow_cotangents"} < named
    adjoints = ("back", "cotangents", "adjoint", "transpose")
    later = {one.key for one in launched if one.key.endswith(adjoints)}
    assert named == later | {"multigrid_iterate", "multigrid_prepare", "ordinates_light"}


def fill_kernels():
    return [TextKernel(f"fill_{k}", 64, "out[item] = 1;", "F *out", "out") for k in range(5)]


def replace_compiler(monkeypatch, load):
    monkeypatch.setattr(compiling.wp, "load_module", lambda module, **_: load(module))


def test_who_needs_a_kernel_first_compiles_it(nothing_loaded, monkeypatch):
    """What nobody has begun, whoever was asked for it; for what was begun it waits.

    Those who were asked begin with what was named last.
    """
    first, second, third, fourth, fifth = (kernel.kernel for kernel in fill_kernels())
    may_end, threads = threading.Event(), dict[Any, list[str]]()

    def compile(module):
        threads.setdefault(module, []).append(threading.current_thread().name)
        if module is first.module:
            has_begun.set()
            may_end.wait(60)

    has_begun = threading.Event()
    replace_compiler(monkeypatch, compile)
    compiling.name_kernel(first, "cpu")
    has_begun.wait(60)
    for kernel in (second, first, fourth, fifth):
        compiling.name_kernel(kernel, "cpu")
    own = threading.current_thread().name
    for kernel in (second, third):
        compiling.load(kernel, "cpu")
        assert threads[kernel.module] == [own]
    may_end.set()
    compiling._pool(1).submit(int).result(60)
    assert [*threads] == [kernel.module for kernel in (first, second, third, fifth, fourth)]
    for kernel in (first, second, third, fourth, fifth):
        compiling.load(kernel, "cpu")
    assert threads[first.module] != [own] and [len(each) for each in threads.values()] == [1] * 5


def test_what_another_thread_cannot_compile_is_an_error_here(nothing_loaded, monkeypatch):
    def fail(module):
        raise OSError("no compiler")

    replace_compiler(monkeypatch, fail)
    kernel = fill_kernels()[0].kernel
    compiling.name_kernel(kernel, "cpu")
    for _ in range(2):
        with pytest.raises(OSError, match="no compiler"):
            compiling.load(kernel, "cpu")
