"""What is wrong with a scene file is told at once: torch and numpy are not loaded to say so."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ddrecon.cli.session import Session

SCENE = "{volume: {bounds: 3, resolution: [1, 1], densty: 1}, views: [{camera: {}}]}"
TABLE = """
check missing.yaml
check missing
check wrong.yaml
optimize wrong.yaml -o out --iterations 3
render wrong.yaml -o out --ring 3
render scene.yaml -o out -D volume.g=2
gradcheck scene.yaml -D volume.desity=1
reference scene.yaml -o out -D views=3
bench scene.yaml -D volume
info wrong.yaml
export wrong.yaml -o out.vdb
check scene.yaml --dtype float16
info gone.vdb
export gone.npz -o out.vdb
"""
COMMANDS = [line.split() for line in TABLE.strip().splitlines()]
PROGRAM = f"""
import sys
from click.testing import CliRunner
from ddrecon.cli.commands import main
for command in {COMMANDS!r}:
    done = CliRunner().invoke(main, command)
    print(done.exit_code, bool(done.stderr), *({{"torch", "numpy", "warp"}} & set(sys.modules)))
"""


def test_errors_of_a_scene_file_need_no_torch(folder: Path) -> None:
    Path("wrong.yaml").write_text(SCENE)
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.stderr == ""
    assert [line[1:] for line in done.stdout.splitlines()] == [" True"] * len(COMMANDS)
    assert [line[0] for line in done.stdout.splitlines()] == ["2"] * (len(COMMANDS) - 2) + ["3"] * 2


@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_results_that_cannot_be_written_are_one_line(argument: str) -> None:
    command = [sys.executable, "-m", "ddrecon", argument]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    line = "cannot write: No space left on device\n"
    assert (done.returncode, done.stderr) == (3, line)


def test_threads_are_no_more_than_cores_that_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})
    session = Session()
    session.start()
    assert session.threads == torch.get_num_threads() == 1
