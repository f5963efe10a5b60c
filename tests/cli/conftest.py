"""Commands on a small scene in a folder of its own, run in this process."""

from pathlib import Path

import numpy as np
import pytest
from small_scene import contents


@pytest.fixture
def succeed(run):
    """Runs a command that must exit with 0."""

    def run_well(*arguments):
        result = run(*arguments)
        assert result.exit_code == 0, result.stderr
        return result

    return run_well


@pytest.fixture
def refuse(run, folder):
    """The lines on stderr of a command that must exit with `code`, and print and write nothing."""

    def run_badly(code, *arguments):
        before = contents(folder)
        result = run(*arguments)
        assert (result.exit_code, result.stdout) == (code, ""), result.output
        assert contents(folder) == before
        return [line.replace(f"{folder}/", "") for line in result.stderr.splitlines()]

    return run_badly


@pytest.fixture
def density_of():
    """The density in the folder of a run."""

    def read(run_folder):
        with np.load(Path(run_folder) / "volumes" / "density.npz", allow_pickle=False) as archive:
            return archive["density"]

    return read
