"""What all commands share: help, versions, errors at once, `--json`, `--engine`, Ctrl-C."""

import json
import logging
import os
import shutil
import subprocess
import sys
import threading
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from ddrecon import __version__, engine
from ddrecon.cli import check
from ddrecon.cli.commands import main
from ddrecon.cli.session import Session
from ddrecon.interrupts import defer_interrupt
from ddrecon.io.images.oiio import write_exr


@pytest.mark.parametrize("command", main.commands)
def test_a_command_says_what_it_does(command):
    result = CliRunner().invoke(main, [command, "--help"])
    assert result.exit_code == 0
    assert main.commands[command].help.splitlines()[0] in " ".join(result.stdout.split())
    computes = command not in ("info", "export", "import")
    for option in ("--device", "--engine", "--threads", "--seed", "--quiet"):
        assert (f" {option} " in result.stdout) == computes
    assert "--debug" in result.stdout
    assert ("-D KEY.PATH=VALUE" in result.stdout) == (command != "import")


SCENE = "{volume: {bounds: 3, resolution: [1, 1], densty: 1}, views: [{camera: {}}]}"
AT_ONCE = """
0 --help
0 check -h
0 --version
2 check missing.yaml
2 check missing
2 check wrong.yaml
2 optimize wrong.yaml -o out --iterations 3
2 render wrong.yaml -o out --ring 3
2 render scene.yaml -o out -D volume.g=2
2 gradcheck scene.yaml -D volume.desity=1
2 reference scene.yaml -o out -D views=3
2 bench scene.yaml -D volume
2 info wrong.yaml
2 export wrong.yaml -o out.vdb
2 check scene.yaml --dtype float16
2 info gone.vdb
2 export gone.npz -o out.vdb
"""
CALLS = [line.split() for line in AT_ONCE.strip().splitlines()]
PROGRAM = f"""
import sys
from click.testing import CliRunner
from ddrecon.cli import commands
commands.DRIVERS = ()
for code, *command in {CALLS!r}:
    done = CliRunner().invoke(commands.main, command)
    heavy = {{"torch", "numpy", "warp"}} | ({{"yaml", "imageio", "tqdm"}} if code == "0" else set())
    print(done.exit_code, bool(done.stderr) == (code != "0"), *(heavy & set(sys.modules)))
"""


def test_help_and_errors_of_a_scene_file_are_told_at_once(folder):
    """Torch and numpy are not loaded to say so."""
    Path("wrong.yaml").write_text(SCENE)
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.splitlines() == [f"{code} True" for code, *_ in CALLS]


def test_a_volume_is_described_without_torch(folder):
    """Which takes seconds to load."""
    np.savez("a.npz", density=np.ones((2, 2, 2)))
    said = "from ddrecon.cli.commands import main; main(['info', 'a.npz'], standalone_mode=False)"
    code = f"import sys; {said}; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["False"], done.stderr


@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_results_that_cannot_be_written_are_one_line(argument):
    command = [sys.executable, "-m", "ddrecon", argument]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    line = "cannot write: No space left on device\n"
    assert (done.returncode, done.stderr) == (3, line)


def test_threads_are_no_more_than_cores_that_may_be_used(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})
    session = Session()
    session.start()
    assert session.threads == torch.get_num_threads() == 1


@pytest.mark.parametrize("command", [["check", "-D", "optimize=null"], ["info"]])
def test_json_prints_what_it_would_write(succeed, command):
    """And takes no scene for a file to write; nothing is optimized, as times differ."""
    scene = Path("scene.yaml").read_text()
    printed = succeed(*command, "--json", "scene.yaml").stdout
    plain = succeed(*command, "scene.yaml").stdout
    assert succeed(*command, "scene.yaml", "--json", "report.json").stdout == plain
    succeed(*command, "scene.yaml", "--json=other")
    assert json.loads(printed) == json.loads(Path("report.json").read_text())
    assert Path("other").read_bytes() == Path("report.json").read_bytes()
    assert Path("scene.yaml").read_text() == scene and not plain.startswith("{")


@pytest.fixture
def installed(monkeypatch):
    """warp-lang 9.8.7 is installed, and taken unless another engine is asked for."""
    monkeypatch.setattr(engine, "find_spec", {"warp": "found"}.get)
    monkeypatch.setattr(metadata, "version", {"warp-lang": "9.8.7", "torch": "1.2"}.get)
    monkeypatch.setenv("DDRECON_ENGINE", "auto")


@pytest.mark.usefixtures("installed")
def test_the_engine_that_computes_is_told(run, monkeypatch):
    python = ".".join(map(str, sys.version_info[:3]))
    (line,) = run("--version").stdout.splitlines()
    versions = f"ddrecon {__version__}, Python {python}, torch 1.2, engine warp (warp-lang 9.8.7)"
    assert line.startswith(f"{versions}, device ")
    for name, taken in (("warp", "warp"), ("auto", "warp"), ("torch", "torch")):
        result = run("check", "scene.yaml", "--engine", name)
        assert f"engine: {taken}" in result.stdout.splitlines()
    run("optimize", "scene.yaml", "-o", "out", "-q", "--engine", "torch", "--iterations", "1")
    environment = json.loads(Path("out/environment.json").read_text())
    assert environment["engine"] == "torch" and "warp-lang" not in environment
    assert "<td>engine</td><td>torch</td>" in Path("out/report.html").read_text()


@pytest.mark.usefixtures("installed")
def test_an_engine_that_cannot_be_is_refused(refuse, succeed, monkeypatch):
    monkeypatch.setattr(engine, "find_spec", {}.get)
    command = "check", "scene.yaml", "--engine"
    texts = succeed(*command, "auto").stderr, succeed(*command, "torch").stderr
    assert ['pip install "ddrecon[fast]"' in text for text in texts] == [True, False]
    command = "optimize", "scene.yaml", "-o", "out", "--engine"
    (line,) = refuse(3, *command, "warp")
    assert line.startswith("engine warp: needs warp: pip install")
    assert "'cuda' is not one of" in refuse(2, *command, "cuda")[-1]
    monkeypatch.setattr(engine, "_engine", None)
    monkeypatch.setenv("DDRECON_ENGINE", "cuda")
    for asked in (command[:-1], ("--version",)):
        (line,) = refuse(2, *asked)
        assert line.startswith("DDRECON_ENGINE=cuda: no such engine; known: auto, torch, warp")


@pytest.mark.parametrize(("quiet", "count"), [((), 1), (("-q",), 0)])
def test_a_compilation_is_announced_once(succeed, monkeypatch, quiet, count):
    describe = check.describe

    def compile_and_describe(*scene):
        logging.getLogger("ddrecon.engine").warning("compiling")
        return describe(*scene)

    monkeypatch.setattr(check, "describe", compile_and_describe)
    for _ in range(2):
        assert succeed("check", "scene.yaml", *quiet).stderr.count("compiling") == count


PRESS = """
import importlib.abc, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
press = lambda: os.kill(os.getpid(), signal.SIGINT)
class PressAt(importlib.abc.MetaPathFinder):
    def __init__(self, module): self.module = module
    def find_spec(self, name, *_):
        if name == self.module: press()
"""
CHECK = "from ddrecon.cli import main; main(['check', 'scene.yaml'])"
MOMENTS = {
    "click is imported": f"sys.meta_path.insert(0, PressAt('click')); {CHECK}",
    "torch is imported": f"sys.meta_path.insert(0, PressAt('torch')); {CHECK}",
    "a command runs": f"""
import ddrecon.scene_file.load as load
load._text = lambda path: press()
{CHECK}""",
    "an interrupt is on its way": f"""
import ddrecon.scene_file.load as load
def read(path):
    try: press()
    finally: press()
load._text = read
{CHECK}""",
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupt_is_one_line_and_code_130(folder, moment):
    command = [sys.executable, "-c", PRESS + MOMENTS[moment]]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_other_threads_are_not_interrupted():
    """As of whoever iterates over `optimize_sequence` in one: there are no signals there."""
    asked = list[list[int]]()

    def work():
        with defer_interrupt() as numbers:
            asked.append(numbers)

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert asked == [[]]


STRANGE = os.fsdecode(b"caf\xe9")
NAMED = {
    f"render scene.yaml -o {STRANGE}/out": "out/ddrecon.manifest: cannot be written: its name is",
    f"export scene.yaml -o {STRANGE}/smoke.vdb": "smoke.vdb: cannot be written: its name is not",
    f"optimize {STRANGE}/scene.yaml -o out -q": "front.npy: cannot be named in scene.yaml",
    f"info {STRANGE}/a.exr": "a.exr: cannot be read: its name is not UTF-8; rename it",
}


@pytest.mark.parametrize("command", NAMED)
def test_names_that_are_no_utf8_are_used_or_refused(folder, refuse, command):
    shutil.copytree(folder, folder / STRANGE)
    if ".exr" in command:
        pytest.importorskip("OpenImageIO")
        write_exr(folder / "a.exr", np.ones((4, 4, 3), np.float32))
        shutil.move(folder / "a.exr", folder / STRANGE)
    (line,) = refuse(3, *command.split())
    assert NAMED[command] in line and line.isprintable()
