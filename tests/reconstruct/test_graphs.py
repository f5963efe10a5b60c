"""Iterations that are recorded and replayed find what plain ones find, on a simulated GPU."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import make_camera, make_scene, random_values
from simulated_gpu import Distant, Program, put, record, simulated_gpu
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.kernels.capture import exchange
from ddrecon.reconstruct import graphs, loop
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.graphs import Graphs
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.setup import targets_of
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.settings import OptimizeSettings, ParameterSettings
from ddrecon.variables.values import value_of

pytestmark = pytest.mark.slow
EYES = (0.2, 0.3, 2.5), (2.3, 0.2, 0.3), (-1.4, 0.5, -2.0)


@pytest.fixture(autouse=True)
def engine(monkeypatch: pytest.MonkeyPatch):
    """Warp with graphs, on one thread, as a GPU is one; nothing was told before."""
    monkeypatch.setattr(graphs, "_told", set())
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    use_engine("warp-graph")
    yield
    torch.set_num_threads(threads)


@functools.cache
def scene_of(eyes: tuple[Any, ...] = EYES[:2], **kind: Any) -> Scene:
    """Views by `eyes` of a medium of three colors, whose pictures are of a somewhat denser one."""
    density = 2 * random_values(4, 5, 6, dtype=torch.float32)
    settings = {"transport_rounds": 0, "tolerance": 1e-2, "g": 0.4, "directional": (3.0, 2.0, 1.0)}
    scene = make_scene(density, **settings | kind)
    size = (6, 7)
    cameras = [make_camera(eye=eye, size=size, dtype=torch.float32) for eye in eyes]
    view = scene.views[0]
    views = [replace(view, name=f"v{i}", camera=camera) for i, camera in enumerate(cameras)]
    denser = replace(scene, volume=replace(scene.volume, density=1.2 * density))
    images = render_each(denser, views, SolveMemory())
    views = [replace(view, image=image) for view, image in zip(views, images, strict=True)]
    return replace(scene, views=views)


def compare(scene: Scene) -> Comparison:
    return Comparison(scene.views, targets_of(scene, "l2", {}))


def iterate(
    scene: Scene,
    recorder: Graphs,
    names: tuple[str, ...],
    factors: tuple[float, ...],
    floor: float = 0.0,
) -> list[tuple[dict[str, Tensor], dict[str, Tensor]]]:
    """Derivatives by `names` of values times each of `factors`, by the `recorder` and plainly.

    The last one's solves are as exact as the scene asks, the others' as `floor` says.
    """
    found, own, other = [], SolveMemory(), SolveMemory()
    for memory in (own, other):
        memory.tolerance_floor = {"forward": floor, "adjoint": floor}
    for number, factor in enumerate(factors):
        if number == len(factors) - 1:
            own.tolerance_floor = other.tolerance_floor = {}
        values = {
            name: (factor * value_of(scene, name)).detach().requires_grad_() for name in names
        }
        one, two = compare(scene), compare(scene)
        replayed = recorder.differentiate(scene, values, one, own)
        plain = differentiate(scene, [view.name for view in scene.views], values, two, other)
        assert [float(x) for x in one.losses] == pytest.approx([float(x) for x in two.losses])
        assert list(one.pictures) == list(two.pictures)
        found.append((replayed.gradients, plain.gradients))
        other.last = dict(own.last)
    return found


def assert_same(pairs: list[tuple[dict[str, Tensor], dict[str, Tensor]]], most: float) -> None:
    for replayed, plain in pairs:
        for name, one in replayed.items():
            assert float((one - plain[name]).norm() / plain[name].norm()) <= most


class Exchanges(TorchDispatchMode):
    """What makes a processor wait for the GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        what = exchange(function, arguments, options or {})
        self.seen += [] if what is None else [what]
        return function(*arguments, **(options or {}))


def test_a_run_by_replays_is_that_of_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three views an iteration; and of its tensors the two are read: verdicts and losses."""
    start = ParameterSettings(init=0.5, min=0.0)
    settings = OptimizeSettings({"density": start}, 6, refine_at=(), views_per_iteration=2)
    scene = replace(scene_of(eyes=EYES, transport_rounds=1), optimize=settings)
    scene = replace(scene, starts={"density": torch.full_like(scene.volume.density, 0.5)})
    plain = Reconstruction(scene)
    expected = [plain.step() for _ in range(5)]
    monkeypatch.setattr(loop, "Graphs", functools.partial(Graphs, record))
    with simulated_gpu():
        run = Reconstruction(put(scene))
        rows = [run.step() for _ in range(4)]
        with Exchanges() as exchanges:
            rows.append(run.step())
        assert len(run.graphs.recording.views) == 3
        assert not run.graphs.is_off
        assert len(exchanges.seen) == 2
    assert [row.loss for row in rows] == pytest.approx([row.loss for row in expected], rel=1e-5)
    value = run.parameters[0].value.near
    assert torch.allclose(value, plain.parameters[0].value, atol=1e-5)


CASES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "no flux": ({"g": 0.0, "transport_rounds": 1}, ("density",)),
    "albedo": ({"ambient": (0.3, 0.2, 0.1)}, ("density", "albedo", "lights.0.irradiance")),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_replays_find_the_derivatives_of_a_plain_run(case: tuple[dict[str, Any], Any]) -> None:
    scene = scene_of(**case[0])
    with simulated_gpu():
        recorder = Graphs(record)
        pairs = iterate(put(scene), recorder, case[1], (1.0, 1.03, 1.1))
        assert_same(pairs, 1e-6)
        assert recorder.recording is not None


def test_two_recordings_do_the_same() -> None:
    """Whatever the values: a program is known by its operations, its kernels and all sizes."""
    known = []

    def noting(computation: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        made, again = record(computation)
        program = again.__self__
        assert isinstance(program, Program)
        known.append(program.described)
        return made, again

    scene = scene_of()
    with simulated_gpu():
        for factor in (1.0, 1.3):
            iterate(put(scene), Graphs(noting), ("density",), (factor, factor))
    half = len(known) // 2
    assert half == 4
    assert known[:half] == known[half:]


def test_a_solve_that_needs_more_iterations_is_made_plainly() -> None:
    """As they do once tolerances fall; the next iteration is recorded anew."""
    near = scene_of(tolerance=1e-5)
    with simulated_gpu():
        recorder = Graphs(record)
        pairs = iterate(put(near), recorder, ("density",), (1.0, 1.0, 3.0), floor=0.5)
        assert not recorder.is_off
        assert recorder.recording is None
    assert_same(pairs, 1e-6)


def test_what_cannot_be_recorded_says_why(caplog: pytest.LogCaptureFixture) -> None:
    """Where a light goes decides in which order cells are gone through."""
    scene = scene_of()
    with simulated_gpu():
        recorder = Graphs(record)
        pairs = iterate(put(scene), recorder, ("density", "lights.0.direction"), (1.0, 1.1))
        assert_same(pairs, 1e-6)
        assert recorder.is_off
    (line,) = caplog.messages
    assert line.startswith("iterations run without CUDA graphs: _to_copy from one memory to anoth")
    assert line.endswith("in light/fused/sum_mass.py")


def test_a_replay_that_differs_is_not_believed(caplog: pytest.LogCaptureFixture) -> None:
    """It is found out with other values than it was recorded with."""

    def record_once(computation: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        made, again = record(computation)
        count = iter(range(100))
        return made, lambda: again() if next(count) == 0 else None

    scene = scene_of()
    with simulated_gpu():
        recorder = Graphs(record_once)
        pairs = iterate(put(scene), recorder, ("density",), (1.0, 1.05, 1.2, 1.1))
        assert_same(pairs, 1e-6)
    assert recorder.is_off
    (line,) = caplog.messages
    assert line.startswith("iterations run without CUDA graphs: a replay is off by")


def test_without_a_gpu_a_line_says_so(caplog: pytest.LogCaptureFixture) -> None:
    pairs = iterate(scene_of(), Graphs(), ("density",), (1.0, 1.1))
    assert_same(pairs, 1e-6)
    assert caplog.messages == ["iterations run without CUDA graphs: they need a GPU"]


def test_other_engines_record_nothing(caplog: pytest.LogCaptureFixture) -> None:
    use_engine("warp")
    assert Graphs().is_off
    assert not caplog.messages


def test_numbers_do_not_get_to_the_simulated_gpu_unseen() -> None:
    """What the other tests rest on."""
    with simulated_gpu(), Exchanges() as exchanges:
        far = put(torch.arange(6.0))
        assert isinstance(far, Distant)
        assert float(far.sum()) == 15.0
        assert far.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
        assert far[far > 3].shape == (2,)
        assert far.nonzero().shape == (5, 1)
        far[[1, 2]]
        torch.tensor([1.0], device=far.device)
        far.new_tensor(1.0)
        with pytest.raises(AssertionError, match="two devices"):
            far + torch.ones(6)
    assert len(exchanges.seen) == 7
