"""Memory is predicted; too much is refused with what would fit, and a shortage is one line."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import Result
from media import half_empty, make_scene

from ddrecon import memory
from ddrecon.cli.check import memory_estimate
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.io.volumes.table import write_field
from ddrecon.kernels import spare
from ddrecon.light.lights import PointLight
from ddrecon.memory import Needs, is_shortage, memory_of
from ddrecon.renderer import render_each
from ddrecon.run import render_folder
from ddrecon.scene_file import build
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

Run = Callable[..., Result]
COMMANDS = {
    "render": ["render", "scene.yaml", "-o", "out"],
    "optimize": ["optimize", "scene.yaml", "-o", "out"],
    "gradcheck": ["gradcheck", "scene.yaml"],
    "check": ["check", "scene.yaml"],
}
LINE = (
    r"scene\.yaml:3:15: volume\.resolution: takes about [\d.]+ GiB, "
    r"but this machine has [\d.]+ [GM]iB free; this would fit: .*"
)


@pytest.mark.parametrize("command", COMMANDS)
def test_what_does_not_fit_is_refused_before_it_is_made(run: Run, command: str) -> None:
    text = Path("scene.yaml").read_text()
    Path("scene.yaml").write_text(text.replace("[16, 4, 3]", "[1024, 1024, 1024]"))
    result = run(*COMMANDS[command])
    assert (result.exit_code, result.stdout) == (2, "") and re.fullmatch(LINE + "\n", result.stderr)
    assert not Path("out").exists()


@pytest.mark.parametrize(
    "change",
    [
        [],
        ["--dtype", "float64", "-D", "diffusion.transport_rounds=1"],
        ["-D", "diffusion.model=flux_limited"],
    ],
    ids=str,
)
def test_what_is_said_to_fit_fits(
    run: Run, monkeypatch: pytest.MonkeyPatch, change: list[str]
) -> None:
    """Each of the proposals, made one after another, is taken."""
    large = ["check", "scene.yaml", "-D", "volume.resolution=[96, 64, 64]", *change]
    free = 110 * 2**20
    monkeypatch.setattr(memory, "free_memory", lambda _: free)
    result = run(*large)
    assert result.exit_code == 2
    proposals = result.stderr.strip().partition("this would fit: ")[2].split(", or ")
    for proposal in proposals:
        key, _, value = proposal.removeprefix("-D ").partition(": " if ": " in proposal else "=")
        words = proposal.split() if proposal.startswith("--") else ["-D", f"{key}={value}"]
        assert run(*large, *words).exit_code == 0


def test_what_barely_fits_gives_freed_memory_back(monkeypatch: pytest.MonkeyPatch) -> None:
    needs, cpu = Needs((96, 96, 96), 3, 4, 0, varied=7), torch.device("cpu")
    free, calls = memory_of(needs), list[str]()
    monkeypatch.setattr(memory, "free_memory", lambda _: free)
    monkeypatch.setattr(memory, "give_freed_memory", lambda: calls.append("given"))
    assert memory.make_room(needs, cpu) is None and not calls
    free = memory_of(needs, is_short=True)
    assert memory.make_room(needs, cpu) is None and calls == ["given"]
    free -= 1
    assert "this would fit" in (memory.make_room(needs, cpu) or "") and calls == ["given"]


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        [
            "volume.sigma_s=[1, 2, 3]",
            "optimize.parameters={density: {}, sigma_s: {field: true}, sigma_a: {}}",
        ],
        ["diffusion.transport_rounds=2", "volume.density={file: density.npz}"],
        ["diffusion.model=flux_limited"],
    ],
    ids=str,
)
def test_the_prediction_is_the_estimate(
    run: Run, monkeypatch: pytest.MonkeyPatch, overrides: list[str]
) -> None:
    """What is predicted from the scene file alone is what `check` says of the tensors."""
    bounds = torch.tensor([[-0.5, -0.3, -0.3], [0.5, 0.3, 0.3]]).numpy()
    write_field(Path("density.npz"), "density", torch.rand(3, 4, 16).numpy(), bounds)
    predicted: list[Needs] = []
    monkeypatch.setattr(build, "make_room", lambda needs, _: predicted.append(needs))
    scene = load_scene("scene.yaml", overrides=overrides)
    assert memory_of(predicted[0]) == memory_estimate(scene) > 0


@pytest.mark.parametrize("case", ["lights", "gray rounds"])
def test_copies_of_many_threads_are_predicted_and_bounded(
    monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    """Bytes that 64 threads add to, beyond those of two, by what kernels are handed."""
    pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
    from ddrecon.kernels.text import TextKernel

    density, gray = half_empty(6, 10, 12, dtype=torch.float32), case == "gray rounds"
    sections = {"sigma_a": (1.0,), "sigma_s": (6.0,), "directional": (2.0,)} if gray else {}
    rounds = 1 if "rounds" in case else 0
    scene = make_scene(density, g=0.4, degree=1, transport_rounds=rounds, **sections)
    if case == "lights":
        place, power = density.new_tensor([0.9, 0.7, 0.2]), density.new_tensor([1.0])
        scene.lights += [PointLight(place, power), PointLight(-place, power)]
    use_engine("warp")

    def copies(threads: int) -> int:
        """The most bytes of copies that a launch has."""
        sizes = [0]
        launch, bind = TextKernel.launch, TextKernel.bind

        def count_launch(self: Any, *given: Any, shares: Any = (), **named: Any) -> None:
            parts = [each for own in shares for value in own.values() for each in listed(value)]
            sizes.append(sum(part.nbytes for part in parts))
            launch(self, *given, shares=shares, **named)

        def count_bind(self: Any, given: Any, made: Any) -> Any:
            if self.name in ("follow_rows", "return_rows"):
                sizes.append(sum(part.nbytes for value in made.values() for part in listed(value)))
            return bind(self, given, made)

        with monkeypatch.context() as patch:
            patch.setattr(TextKernel, "launch", count_launch)
            patch.setattr(TextKernel, "bind", count_bind)
            patch.setattr(torch, "get_num_threads", lambda: threads)
            leaf = density.clone().requires_grad_()
            changed = with_values(scene, {"density": leaf})
            image = render_each(changed, changed.views, SolveMemory())[0]
            torch.autograd.grad(image.sum(), leaf)
        return max(sizes)

    of_two = copies(2)
    needs = Needs((12, 10, 6), 1 if gray else 3, 4, 0, has_flux=True, has_rounds=rounds > 0)
    needs = replace(needs, moments=4, varied=1.0, lights=len(scene.lights), threads=64)
    assert of_two <= copies(64) <= of_two + memory.shared_memory(needs)
    monkeypatch.setattr(spare, "MOST_COPIED", 4 * of_two)
    assert copies(64) <= of_two + memory.shared_memory(needs) <= 5 * of_two
    assert memory.shared_memory(replace(needs, threads=2)) == 0


def listed(value: Any) -> list[torch.Tensor]:
    """The tensors of an argument."""
    parts = value if isinstance(value, list) else [value]
    return [part for part in parts if isinstance(part, torch.Tensor)]


def write_group(folder: Path, files: dict[str, str]) -> None:
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_text(content + "\n")


def test_limits_of_control_groups(tmp_path: Path) -> None:
    write_group(
        tmp_path / "v2/a/b",
        {"memory.max": "1000", "memory.current": "700", "memory.stat": "anon 1\ninactive_file 50"},
    )
    (tmp_path / "v2/a/memory.max").write_text("max\n")
    write_group(
        tmp_path / "v1/memory/c",
        {
            "memory.limit_in_bytes": "900",
            "memory.usage_in_bytes": "100",
            "memory.stat": "total_inactive_file 25\ninactive_file 1",
        },
    )
    own = tmp_path / "own"
    own.write_text("0::/a/b\n")
    assert list(memory._group_limits(tmp_path / "v2", own)) == [350]
    own.write_text("3:cpu,memory:/c\n1:cpu:/\n")
    assert list(memory._group_limits(tmp_path / "v1", own)) == [825]
    assert list(memory._group_limits(tmp_path / "none", own)) == []


def test_a_shortage_is_one_line(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def solve_light(*_: Any) -> torch.Tensor:
        return torch.empty(2**52)

    monkeypatch.setattr(render_folder, "solve_light", solve_light)
    result = run("render", "scene.yaml", "-q", "-o", "out")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("out of memory: ") and result.stderr.count("\n") == 1


def test_other_errors_are_no_shortage() -> None:
    with pytest.raises(RuntimeError) as caught:
        torch.ones(2) @ torch.ones(3)
    assert not is_shortage(caught.value)
    assert is_shortage(torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"))
