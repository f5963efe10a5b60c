"""Memory is predicted; too much is refused with what would fit, and a shortage is one line."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import Result

from ddrecon import memory
from ddrecon.cli.check import memory_estimate
from ddrecon.io.volumes.table import write_field
from ddrecon.memory import Needs, is_shortage, memory_of, usable_cores
from ddrecon.run import render_folder
from ddrecon.scene_file import build
from ddrecon.scene_file.build import load_scene

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


def test_cores_are_those_that_may_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By affinity, and by the smallest quota of a group or of one that it is in."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)))
    own = tmp_path / "own"
    own.write_text("0::/a/b\n3:cpu,cpuacct:/c\n")
    files = {"v2/a/b/cpu.max": "max 100000", "v1/cpu/c/cpu.cfs_quota_us": "-1"}
    files["v1/cpu/c/cpu.cfs_period_us"] = "100000"
    assert usable_cores(tmp_path / "none", own) == 8
    for cores, quota in ((8, files), (3, {"v2/a/cpu.max": "250000 100000"})):
        for name, text in quota.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text + "\n")
        assert usable_cores(tmp_path / "v2", own) == cores
    assert usable_cores(tmp_path / "v1", own) == 8
    (tmp_path / "v1/cpu/c/cpu.cfs_quota_us").write_text("100000")
    assert usable_cores(tmp_path / "v1", own) == 1


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
