"""Memory is predicted; too much is refused with what would fit, and a shortage is one line."""

import re
from pathlib import Path

import pytest
import torch

from ddrecon import memory
from ddrecon.memory import Needs, explain_shortage, usable_cores
from ddrecon.run import render_folder
from ddrecon.scene_file.build import load_scene

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
def test_what_does_not_fit_is_refused_before_it_is_made(run, command):
    text = Path("scene.yaml").read_text()
    Path("scene.yaml").write_text(text.replace("[6, 5, 4]", "[1024, 1024, 1024]"))
    result = run(*COMMANDS[command])
    assert (result.exit_code, result.stdout) == (2, "") and re.fullmatch(LINE + "\n", result.stderr)
    assert not Path("out").exists()


def test_too_many_pixels_are_refused_where_they_were_asked_for(run, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda _: 60 * 2**20)
    result = run(*COMMANDS["render"], "--size", "9999", "9999")
    assert result.exit_code == 2
    assert result.stderr.startswith("--size 9999 9999: views: takes about ")


def require_fit(run, line, *command):
    """Each of the proposals of a `line` about cells, made alone, takes no more than is free."""
    proposals = line.strip().partition("this would fit: ")[2].split(", or ")
    assert proposals
    for proposal in proposals:
        key, _, value = proposal.partition(": ")
        words = ["-D", f"{key}={value}"] if value else proposal.split()
        assert run(*command, *words).exit_code == 0


@pytest.mark.usefixtures("untimed")
@pytest.mark.parametrize(
    "change",
    [
        [],
        ["--dtype", "float64", "-D", "diffusion.transport_rounds=1"],
        ["-D", "diffusion.model=flux_limited"],
        ["-D", "diffusion.refine=3"],
    ],
    ids=str,
)
def test_what_is_said_to_fit_fits(run, monkeypatch, change):
    large = ["check", "scene.yaml", "-D", "volume.resolution=[96, 64, 64]", *change]
    monkeypatch.setattr(memory, "free_memory", lambda _: 60 * 2**20)
    result = run(*large)
    assert result.exit_code == 2
    require_fit(run, result.stderr, *large)


@pytest.mark.parametrize("part", [0.9, 0.3])
def test_smaller_images_are_said_to_fit_where_cells_do(monkeypatch, part):
    needs = Needs((20, 20, 20), 40, 10**6, 4)
    monkeypatch.setattr(memory, "free_memory", lambda _: int(part * needs.total))
    line = memory.refuse_excess(needs, torch.device("cpu")) or ""
    width = int(re.findall(r"images of (\d+)%", line)[0]) / 100
    fits = [
        Needs((20, 20, 20), 40, int(10**6 * share**2), 4).total for share in (width, 1.05 * width)
    ]
    assert fits[0] <= part * needs.total < fits[1]


def write_group(folder, files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_text(content + "\n")


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Has this process be in other control groups, as /proc/self/cgroup says it."""
    monkeypatch.setattr(memory, "GROUPS", tmp_path)
    monkeypatch.setattr(memory, "OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)))
    return lambda text: (tmp_path / "own").write_text(text) and None


@pytest.mark.parametrize(
    ("own", "limit", "used"),
    [
        ("0::/a/b\n", "memory.max", "anon 650\nfile 90"),
        ("3:memory:/a/b\n1:cpu:/\n", "memory.limit_in_bytes", "rss 9\ntotal_rss 650"),
    ],
)
def test_limits_of_control_groups(tmp_path, groups, own, limit, used):
    """The least that a group, or one that it is in, has left; "max" is none."""
    cpu, top = torch.device("cpu"), tmp_path / ("memory" if "memory" in own else "")
    machine = memory.free_memory(cpu)
    groups(own)
    assert machine is None or memory.free_memory(cpu) > 1000
    write_group(top / "a/b", {limit: "1000", "memory.stat": used})
    write_group(top / "a", {limit: "max", "memory.stat": used})
    assert memory.free_memory(cpu) == 350
    (top / "a" / limit).write_text("700")
    assert memory.free_memory(cpu) == 50


def test_cores_are_those_that_may_be_used(tmp_path, groups):
    """By affinity, and by the smallest quota of a group or of one that it is in."""
    groups("0::/a/b\n")
    assert usable_cores() == 8
    write_group(tmp_path / "a/b", {"cpu.max": "max 100000"})
    assert usable_cores() == 8
    (tmp_path / "a/cpu.max").write_text("250000 100000\n")
    assert usable_cores() == 3
    groups("3:cpu,cpuacct:/c\n")
    files = {"cpu.cfs_quota_us": "-1", "cpu.cfs_period_us": "100000"}
    write_group(tmp_path / "cpu,cpuacct/c", files)
    assert usable_cores() == 8
    (tmp_path / "cpu,cpuacct/c/cpu.cfs_quota_us").write_text("100000\n")
    assert usable_cores() == 1


CUDA = (
    "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 139.81 GiB of "
    "which 1.20 GiB is free. If reserved but unallocated memory is large try setting "
    "PYTORCH_CUDA_ALLOC_CONF=expandable_segments:True to avoid fragmentation.  See documentation"
)


def ask_for_too_much():
    torch.empty(2**52)


def fail_on_a_gpu():
    raise torch.cuda.OutOfMemoryError(CUDA)


@pytest.mark.parametrize(
    ("shortage", "amount"),
    [(ask_for_too_much, "18014398509481984 bytes"), (fail_on_a_gpu, "2.00 GiB")],
)
def test_a_shortage_is_one_line_that_says_what_would_fit(run, monkeypatch, shortage, amount):
    """That takes at most half of what was predicted, since more was needed."""
    monkeypatch.setattr(render_folder, "solve_light", lambda *_: shortage())
    result = run("render", "scene.yaml", "-q", "-o", "out", "--dtype", "float64")
    assert (result.exit_code, result.stdout) == (2, "")
    begin, _, fits = result.stderr.partition("this would fit: ")
    assert begin == f"out of memory: {amount} is not free; " and result.stderr.count("\n") == 1
    assert "--dtype float32" in fits and "volume.resolution: [" in fits
    load_scene("scene.yaml", dtype=torch.float64)
    half = memory._latest[0].total // 2
    monkeypatch.setattr(memory, "free_memory", lambda _: half)
    require_fit(run, result.stderr.partition(", or images")[0], "check", "scene.yaml")


def test_other_errors_are_no_shortage():
    with pytest.raises(RuntimeError) as caught:
        torch.ones(2) @ torch.ones(3)
    assert explain_shortage(caught.value) is None
    assert "out of memory" in (explain_shortage(MemoryError()) or "")
