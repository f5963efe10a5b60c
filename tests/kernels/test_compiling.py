"""A rehearsal comes to every kernel that is launched in earnest, and leaves nothing behind."""

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

pytest.importorskip("warp")

from ddrecon.engine import LOG, use_engine
from ddrecon.kernels import compiling
from ddrecon.kernels import launch as launching
from ddrecon.kernels.text import TextKernel
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"
SMALL = ["volume.resolution=[10,12,8]", "volume.g=0.3"]


class Loads(list[object]):
    """Kernels made ready; `unload` has the process forget those it had."""

    def unload(self) -> None:
        compiling._loaded.clear()
        self.clear()


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> Iterator[Loads]:
    """Which kernels are made ready while it lasts."""
    seen = Loads()
    real = compiling.wp.load_module
    monkeypatch.setattr(
        compiling.wp, "load_module", lambda module, **of: (seen.append(module), real(module, **of))
    )
    seen.unload()
    yield seen
    compiling._loaded.clear()


def first_iteration() -> torch.Tensor:
    run = Reconstruction(load_scene(BALL, overrides=SMALL))
    run.step()
    return run.parameters[0].value.detach()


@pytest.mark.slow
def test_an_iteration_needs_no_other_kernels(
    loads: Loads, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    use_engine("warp")
    with caplog.at_level(logging.DEBUG, LOG):
        ahead = first_iteration()
    assert "ended early" not in caplog.text
    # All were made ready by the rehearsal, each once; now as an iteration comes to them.
    side_by_side = list(loads)
    loads.unload()
    monkeypatch.setattr("ddrecon.reconstruct.loop._compile_ahead", lambda _: None)
    assert torch.equal(first_iteration(), ahead)
    assert len(side_by_side) == len(set(side_by_side))
    assert set(side_by_side) == set(loads)


def fill_kernels() -> list[TextKernel]:
    return [TextKernel(f"fill_{k}", 64, "out[item] = 1;", "F *out", "out") for k in range(3)]


def test_kernels_do_nothing_in_a_rehearsal(loads: Loads, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("launched")

    monkeypatch.setattr(launching, "_call", fail)
    monkeypatch.setattr(compiling.wp, "load_module", lambda module, **_: loads.append(module))
    kernels = fill_kernels()
    found = []

    def computation() -> None:
        for kernel in kernels:
            found.append(torch.ones(4, dtype=torch.float64))
            kernel.launch(4, {}, {"out": found[-1]})
        raise ValueError("zeros may lead astray")

    compiling.compile_rehearsed(computation)
    assert not torch.stack(found).any()
    for kernel in kernels:
        with pytest.raises(AssertionError, match="launched"):
            kernel.launch(4, {}, {"out": found[0]})
    assert sorted(map(id, loads)) == sorted(id(kernel.module) for kernel in kernels)
    # Where a process has kernels, nothing is rehearsed.
    compiling.compile_rehearsed(lambda: found.append("again"))
    assert "again" not in found


def test_while_kernels_are_compiled_lines_say_how_far_that_is(
    loads: Loads, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Before the first is done, at a level that Python shows unasked, and not of what is cached."""
    use_engine("warp")
    kernels = fill_kernels()
    is_told = threading.Semaphore(0)
    monkeypatch.setattr(compiling, "COMPILED", 0.0)
    monkeypatch.setattr(compiling, "PAUSE", 0.0)
    monkeypatch.setattr(compiling, "_last_line", -1.0)
    monkeypatch.setattr(compiling, "_compiled", [])
    monkeypatch.setattr(compiling.wp, "load_module", lambda *_, **__: is_told.acquire(timeout=60))
    real = compiling._tell
    monkeypatch.setattr(compiling, "_tell", lambda *of: (real(*of), is_told.release()))
    with caplog.at_level(logging.WARNING, LOG):
        for kernel in kernels:
            compiling.load(kernel.kernel, "cpu", len(kernels))
        lines = [record.getMessage() for record in caplog.records]
        assert len(lines) == 3 and "once" in lines[0] and "fill_2" in lines[2]
        assert "2 of at most 3 done" in lines[2]
        for kernel in kernels:
            compiling.load(kernel.kernel, "cpu")
    assert len(caplog.records) == 3
