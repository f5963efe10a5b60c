"""What some minutes of a GPU are to tell, and what matters most first.

    python benchmarks/gpu_check.py [STAGE]... [--device cuda] [--shrink 1] [--engine warp]

Without names all stages run, in their order: machine, kernels, speed, agree, bits, graphs,
optimize, tests, top, shortage. Each prints its table line by line, and the seconds it took. A stage
that fails says so, the next one goes on, and the exit status is 1. All of it is also in
`$OUT/gpu_check.txt`, where that is set. Configs have pictures in EXR: besides what ddrecon needs,
stages need Warp, OpenImageIO and pytest. `--device cpu --shrink 4` tries the script where there is
no GPU: grids and images are four times smaller, and kernels are not optimized.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from figures import ROOT
from runs import CONFIGS, apart, start_config, start_paper_case, start_plume, start_run
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from ddrecon.bench import plume_scene
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.errors import MissingExtraError, SceneError, UsageError
from ddrecon.lighting import solve_light
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of, variable_names, with_values

CELLS = 3000
"""Scenes are compared in at most about so many cells."""
AGREEMENT = 1e-9
"""What else than rounding makes a difference is more: solves end at the same iteration."""
SECONDS = 6.0
"""So long iterations of one run are timed, at most twelve of them."""


@dataclass(frozen=True)
class Check:
    """On which device and engine stages run, and how many times smaller their scenes are."""

    device: torch.device
    shrink: int
    engine: str

    @property
    def is_gpu(self) -> bool:
        return self.device.type == "cuda"

    def now(self) -> float:
        """The time, once the device has done what it was given."""
        if self.is_gpu:
            torch.cuda.synchronize()
        return time.perf_counter()

    def time_of(self, action: Callable[[], Any], count: int = 1) -> float:
        """Seconds of one `action`, of so many in a row."""
        start = self.now()
        for _ in range(count):
            action()
        return (self.now() - start) / count

    def begin(self, name: str) -> Reconstruction:
        """One of `runs`, as it begins each time."""
        torch.manual_seed(0)
        return self.runs()[name]()

    def runs(self) -> dict[str, Callable[[], Reconstruction]]:
        """Reconstructions by name, the largest shrunk twice; the paper's are of an RTX 2080 Ti."""
        n = self.shrink
        return {
            "64 x 96 x 64, 256^2, no round (the paper: 29.4/s)": lambda: self.plume(64, 256, 0),
            "64 x 96 x 64, 512^2, no round (the paper: 22.5/s)": lambda: self.plume(64, 512, 0),
            "64 x 96 x 64, 1024^2, no round (the paper: 16.5/s)": lambda: self.plume(64, 1024, 0),
            "64 x 96 x 64, 512^2, a round": lambda: self.plume(64, 512, 1),
            "plume.yaml, 16 x 24 x 16": lambda: start_plume(self.device, 4 * n),
            "plume.yaml, 32 x 48 x 32": lambda: start_plume(self.device, 2 * n),
            "plume.yaml, 64 x 96 x 64": lambda: start_plume(self.device, n),
            "capture.yaml, full resolution": lambda: start_config("capture", self.device, n),
            "168 x 252 x 168, 512^2, RGB fields, a round (the paper: 8 s)": self.joint,
            "256 x 384 x 256, 512^2, a round": lambda: self.plume(256 // n, 512, 1),
        }

    def plume(self, cells: int, pixels: int, rounds: int) -> Reconstruction:
        """The plume of `bench`, from its own image."""
        sizes = cells // self.shrink, pixels // self.shrink
        return start_paper_case(*sizes, rounds, self.device)

    def joint(self) -> Reconstruction:
        """The paper's joint case: density, sigma_a and sigma_s in three colors."""
        scene = plume_scene(168 // self.shrink**2, 512 // self.shrink, torch.float32, self.device)
        volume, shape = scene.volume, (3, *scene.volume.grid.shape)
        colors = torch.tensor([1.0, 0.9, 0.7], device=self.device).view(3, 1, 1, 1)
        fields = {
            name: (getattr(volume, name) * colors).expand(shape).contiguous()
            for name in ("sigma_a", "sigma_s")
        }
        return start_run(replace(scene, volume=replace(volume, **fields)), ("density", *fields))


def machine(check: Check) -> Iterator[str]:
    """The device's name, and what single things cost: these explain all else."""
    yield f"torch {torch.__version__}, {torch.get_num_threads()} threads"
    if check.is_gpu:
        about = torch.cuda.get_device_properties(0)
        yield (
            f"{about.name}, {about.multi_processor_count} multiprocessors, "
            f"{about.total_memory / 2**30:.0f} GiB, L2 {about.L2_cache_size / 2**20:.0f} MiB"
        )
    big = torch.empty(2**27 // check.shrink**2, device=check.device)
    other, tiny = torch.empty_like(big), torch.zeros(16, device=check.device)
    other.copy_(big)
    seconds = check.time_of(lambda: other.copy_(big), 10)
    yield f"copy: {2 * big.nbytes / seconds / 1e12:.2f} TB/s"
    varied = tiny.clone().requires_grad_()
    actions: dict[str, Callable[[], Any]] = {
        "an operation": lambda: tiny + 1,
        "an operation and its adjoint": lambda: (varied * 2).sum().backward(),
        "a number read": lambda: float(tiny[0]),
        "a number written": lambda: tiny.new_tensor(1.0),
    }
    if check.engine == "warp":
        from ddrecon.kernels.text import TextKernel

        kernel = TextKernel("nothing", 32, "out[item] = x[item];", "F *x, *out", "out")
        bound = kernel.bind({"x": tiny}, {"out": torch.empty_like(tiny)})
        actions["a launch, bound"] = lambda: bound.launch(16)
        actions["a launch, bound anew"] = lambda: kernel.launch(16, {"x": tiny}, {"out": tiny})
    for name, action in actions.items():
        action()
        yield f"{name}: {1e6 * check.time_of(action, 2000):.1f} us"


def kernels(check: Check) -> Iterator[str]:
    """The first iteration of some runs, with all kernels compiled."""
    for name in ("64 x 96 x 64, 512^2, a round", "plume.yaml, 16 x 24 x 16"):
        yield f"{name}: first iteration {check.time_of(check.begin(name).step):.1f} s"


def results(path: Path, device: torch.device, cells: float) -> dict[str, Tensor]:
    """What is compared of a scene file, by name, in double precision, from a random density."""
    scene = load_scene(path, dtype=torch.float64, device=device)
    factor = max(1, round((scene.volume.grid.cells / cells) ** (1 / 3)))
    scene = scene_at_level(scene, factor)
    # A processor would take fewer rays where pixels are finer than cells, and a GPU would not.
    scene = replace(scene, views=scene.views[:2], render=replace(scene.render, tolerance=0.0))
    sought = scene.optimize.parameters.keys() if scene.optimize else {"density"}
    values = {
        name: value_of(scene, name).detach()
        for name in sorted(sought)
        if name in variable_names(scene)
    }
    drawn = torch.rand(scene.volume.grid.shape, generator=torch.Generator().manual_seed(1))
    if "density" in values:
        values["density"] = (0.2 + 0.6 * drawn).to(values["density"])
    with torch.no_grad():
        light = solve_light(with_values(scene, values), SolveMemory())
    tensors = {"light": light.diffuse[0]}
    if light.medium.emission is not None:
        tensors["emission"] = light.medium.emission
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    names = [view.name for view in scene.views]
    torch.manual_seed(0)
    back = differentiate(
        scene, names, leaves, lambda _, image: image.square().mean(), SolveMemory()
    )
    tensors |= {f"image {name}": image for name, image in zip(names, back.images, strict=True)}
    return tensors | {f"d {name}": bar for name, bar in back.gradients.items()}


def agree(check: Check) -> Iterator[str]:
    """How far scenes in double precision are from torch on the processor, and what is farthest."""
    engines = sorted({check.engine, "torch"} if check.is_gpu else {check.engine})
    cells, farthest = CELLS / check.shrink, list[float]()
    yield "| scene | engine | light | farthest | of |\n|---|---|---|---|---|"
    for path in sorted([*CONFIGS.glob("*.yaml"), *CONFIGS.glob("kinds/*.yaml")]):
        use_engine("torch")
        try:
            known = results(path, torch.device("cpu"), cells)
        except (MissingExtraError, SceneError) as error:  # of a volume that is not there
            yield f"| {path.stem} | - | - | - | {error} |"
            continue
        for engine in engines:
            use_engine(engine)
            found = results(path, check.device, cells)
            errors = {name: apart(value, known[name]) for name, value in found.items()}
            far = max(errors, key=lambda name: errors[name])
            farthest.extend(errors.values())
            yield f"| {path.stem} | {engine} | {errors['light']:.0e} | {errors[far]:.0e} | {far} |"
    use_engine(check.engine)
    assert all(error <= AGREEMENT for error in farthest), f"farther than {AGREEMENT}"


def speed(check: Check) -> Iterator[str]:
    """Iterations: seconds, what is launched and waited for, how busy the device is, memory."""
    yield (
        "| case | seconds an iteration | iterations a second | launches | graphs | copies | waits "
        "| at work | peak memory | solves |\n|---|---|---|---|---|---|---|---|---|---|"
    )
    for name, begin in check.runs().items():
        yield f"| {name} | {measure(check, begin())} |"


def measure(check: Check, run: Reconstruction) -> str:
    """Cells of the table of `speed`."""
    if check.is_gpu:
        torch.cuda.reset_peak_memory_stats()
    taken = list[float]()
    while len(taken) < 3 or (len(taken) < 14 // check.shrink and sum(taken) < SECONDS):
        taken.append(check.time_of(run.step))
    seconds, seen = median(taken[2:]), ["-"] * 6
    if check.is_gpu:
        with profile(activities=[ProfilerActivity.CUDA]) as recorded:
            run.step()
            check.now()
        rows = recorded.key_averages()

        def count(*keys: str) -> str:
            return f"{sum(row.count for row in rows if any(k in row.key for k in keys)):,}"

        work = sum(row.self_device_time_total for row in rows) / 1e6 / seconds
        calls = "LaunchKernel", "GraphLaunch", "MemcpyAsync", "StreamSynchronize"
        peak = torch.cuda.max_memory_allocated() / 2**30
        seen = [*map(count, calls), f"{work:.0%}", f"{peak:.2f} GiB"]
    solves = " ".join(f"{record.kind[0]}{record.iterations}" for record in run.memory.records)
    return f"{seconds:.4f} | {1 / seconds:.1f} | {' | '.join(seen)} | {solves}"


def graphs(check: Check) -> Iterator[str]:
    """Replayed iterations beside plain ones: seconds of both, and how far apart both runs end.

    A replayed solve makes an iteration more than a plain one: runs differ by as much as solves may.
    """
    for name in ("64 x 96 x 64, 512^2, no round (the paper: 22.5/s)", "plume.yaml, 16 x 24 x 16"):
        ends, seconds = [], []
        for is_plain in (True, False):
            run = check.begin(name)
            if is_plain:
                run.frames[0].replays.new_recorder = None
            seconds.append(median([check.time_of(run.step) for _ in range(12)][4:]))
            ends.append(run.parameters[0].value.detach())
        is_recorded = run.frames[0].replays.recording is not None
        yield (
            f"{name}: {seconds[0]:.4f} s plainly, {seconds[1]:.4f} s replayed "
            f"(recorded: {is_recorded}), apart {apart(*ends):.1e}"
        )
        assert is_recorded == check.is_gpu


def top(check: Check) -> Iterator[str]:
    """Which kernels take the device's time, of the plume at full resolution."""
    run = check.runs()["plume.yaml, 64 x 96 x 64"]()
    run.step(), run.step()
    kind = ProfilerActivity.CUDA if check.is_gpu else ProfilerActivity.CPU
    with profile(activities=[kind]) as recorded:
        run.step()
        check.now()
    key = "self_device_time_total" if check.is_gpu else "self_cpu_time_total"
    rows = sorted(recorded.key_averages(), key=lambda row: -getattr(row, key))
    for row in rows[:20]:
        yield f"{getattr(row, key) / 1e3:9.3f} ms {row.count:6d} x {row.key[:90]}"


def bits(check: Check) -> Iterator[str]:
    """Whether the same run comes to the same bits: 0, or how far apart three iterations end."""
    for name in ("64 x 96 x 64, 512^2, a round", "plume.yaml, 32 x 48 x 32"):
        ends = []
        for _ in range(2):
            run = check.begin(name)
            for _ in range(3):
                run.step()
            ends.append(run.parameters[0].value.detach())
        yield f"{name}: {apart(*ends):.1e}"
        assert torch.equal(*ends)


def run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A process of its own, which has four minutes."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)


def tests(check: Check) -> Iterator[str]:
    """The tests that run on a GPU where there is one; elsewhere the shortest of a device's."""
    chosen = "cuda" if check.is_gpu else f"far and table and {check.engine}"
    end = run_python("-m", "pytest", "-n0", "-q", "tests/test_far_device.py", "-k", chosen)
    yield "\n".join((end.stdout + end.stderr).splitlines()[-8:])
    assert end.returncode == 0


def optimize(check: Check) -> Iterator[str]:
    """The plume from the command line, as anybody runs it."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["-m", "ddrecon", "optimize", str(CONFIGS / "plume.yaml"), "-o", folder]
        command += ["--overwrite", "--device", check.device.type, "--engine"]
        sizes = [size // check.shrink for size in (64, 96, 64)]
        few = ["torch", "--iterations", "3", "-D", f"volume.resolution={sizes}"]
        start = time.perf_counter()
        # The engine torch compiles nothing.
        end = run_python(*command, *([check.engine] if check.shrink == 1 else few))
        yield "\n".join((end.stdout + end.stderr[-600:]).splitlines()[-12:])
        yield f"exit {end.returncode}, {time.perf_counter() - start:.1f} s the whole process"
        assert end.returncode == 0


def shortage(check: Check) -> Iterator[str]:
    """What is said where memory is short: of a quarter of a GiB on a GPU."""
    if not check.is_gpu:
        yield "no GPU, no shortage"
        return
    whole = torch.cuda.get_device_properties(0).total_memory
    text = (
        f"import torch; torch.cuda.set_per_process_memory_fraction({2**28 / whole}); "
        "from ddrecon.cli import main; main()"
    )
    with tempfile.TemporaryDirectory() as folder:
        command = ["-c", text, "optimize", str(CONFIGS / "plume.yaml"), "-o", folder]
        command += ["--overwrite", "--device", "cuda", "-D", "volume.resolution=[192,288,192]"]
        end = run_python(*command)
    yield f"exit {end.returncode}: {end.stderr[-900:]}"
    assert end.returncode == UsageError.exit_code


STAGES = (machine, kernels, speed, agree, bits, graphs, optimize, tests, top, shortage)


def main() -> None:
    """Prints what each stage finds; ends with status 1 if one failed."""
    names = {stage.__name__: stage for stage in STAGES}
    parser = argparse.ArgumentParser()
    parser.add_argument("stages", nargs="*", choices=[[], *names], metavar="STAGE")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--shrink", type=int, default=1)
    parser.add_argument("--engine", choices=ENGINES, default="warp")
    arguments = parser.parse_args()
    check = Check(torch.device(arguments.device), arguments.shrink, arguments.engine)
    use_engine(check.engine)
    folder, failed = os.environ.get("OUT"), False
    if check.shrink > 1 and check.engine == "warp":
        import warp

        warp.config.optimization_level = 0  # as in tests, whose kernels then need no compiling

    def tell(line: str) -> None:
        print(line, flush=True)
        if folder:
            with Path(folder, "gpu_check.txt").open("a", encoding="utf-8") as file:
                print(line, file=file)

    for name in arguments.stages or names:
        start = time.perf_counter()
        try:
            for line in names[name](check):
                tell(line)
        except Exception as error:  # the next stage goes on
            failed = True
            tell(f"FAILED {name}: {''.join(traceback.format_exception(error)[-3:])}")
        tell(f"-- {name}: {math.ceil(time.perf_counter() - start)} s")
    sys.exit(failed)


if __name__ == "__main__":
    main()
