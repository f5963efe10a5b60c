"""What every test has: a seed, one thread, the torch engine, and commands in this process."""

import os
import signal
from importlib.util import find_spec

import pytest
import torch
from click.testing import CliRunner
from hypothesis import settings
from small_scene import write_scene
from zero_tangents import ask_python

from ddrecon.cli.commands import main
from ddrecon.io.volumes.table import WRITTEN

os.environ["OMP_NUM_THREADS"] = "1"
os.environ.setdefault("DDRECON_ENGINE", "torch")  # compiles nothing
torch.set_num_threads(1)  # tests run side by side, one a core
settings.register_profile("patient", deadline=None)  # how loaded the machine is does not matter
settings.load_profile("patient")
ask_python(everything=False)
if find_spec("warp") and "OPTIMIZE_KERNELS" not in os.environ:
    import warp

    warp.config.optimization_level = 0  # compiles in half the time
LONGEST = "test_graphics_cards", "test_shared_runs", "test_vectorized"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest begin first: no process waits for another at the end, or does them again."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)


@pytest.fixture(autouse=True)
def same_engine(monkeypatch):
    """No test depends on the engine that those before it used."""
    monkeypatch.setattr("ddrecon.engine._engine", None)


@pytest.fixture(autouse=True)
def same_seed():
    """No test depends on those before it; the seed decides which views an iteration looks at."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def surroundings(monkeypatch):
    """What commands change in their process is put back; Ctrl-C works in the background too."""
    threads = torch.get_num_threads()
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    yield
    signal.signal(signal.SIGINT, handler)
    torch.set_num_threads(threads)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with scene.yaml, its images front.npy and side.npy, and density.npz."""
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    return tmp_path


@pytest.fixture
def few_directions(monkeypatch):
    """Of a ground's light, which goes along 72: what holds of any number is tried with few."""
    monkeypatch.setattr("ddrecon.march.ground.DOWNWARDS", 6)
    monkeypatch.setattr("ddrecon.light.ground.UPWARDS", 4)


@pytest.fixture
def untimed(monkeypatch):
    """`check` tries no iterations to say how long they take: that is what takes it longest."""
    monkeypatch.setattr("ddrecon.cli.check.time_iteration", lambda _: 1.0)


@pytest.fixture(scope="module")
def shapes_by_python():
    """For devices of their own, of which C++ knows no shapes of sums with numbers."""
    ask_python(everything=True)
    yield
    ask_python(everything=False)


@pytest.fixture(scope="session", params=WRITTEN)
def suffix(request):
    """The suffix of each kind of volume file that is written and read."""
    return request.param


@pytest.fixture
def run(folder):
    """Runs a command in the current folder, which `folder` made; a bug's exception is raised."""

    def run_command(*arguments):
        result = CliRunner().invoke(main, [os.fspath(argument) for argument in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run_command
