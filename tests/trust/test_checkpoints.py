"""Checkpoints: damage costs at most one of them, and only a run of the same inputs goes on."""

import random
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from ddrecon.errors import DataWarning, UsageError
from ddrecon.run import job
from ddrecon.run.job import (
    LAST,
    MOST_CHANGES,
    PREVIOUS,
    load_checkpoint,
    require_same,
    save_checkpoint,
)

pytestmark = pytest.mark.slow

OPTIMIZE = ["optimize", "scene.yaml", "-q", "-o", "out"]
RESUME = [*OPTIMIZE, "--resume"]


def flattened(value):
    if isinstance(value, dict):
        for key, entry in value.items():
            yield key
            yield from flattened(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from flattened(entry)
    else:
        yield value.tolist() if isinstance(value, torch.Tensor) else value


def density(folder="out"):
    with np.load(Path(folder, "volumes", "density.npz"), allow_pickle=False) as archive:
        return archive["density"]


def iterations(folder="out"):
    return [
        int(line.split(",")[0]) for line in Path(folder, "loss.csv").read_text().splitlines()[1:]
    ]


def test_a_changed_bit_anywhere_is_noticed_or_changes_nothing(tmp_path):
    states = [
        {"field": torch.rand(300), "text": "a text", "total": {"iteration": number}}
        for number in (1, 2)
    ]
    for state in states:
        save_checkpoint(tmp_path, state, {"g": 0.1})
    whole, chance, fallbacks = (tmp_path / LAST).read_bytes(), random.Random(0), 0
    for _ in range(60):
        data = bytearray(whole)
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        (tmp_path / LAST).write_bytes(data)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found, path = load_checkpoint(tmp_path, {"g": 0.1})
        assert list(flattened(found)) == list(flattened(states[0 if path.name == PREVIOUS else 1]))
        assert sum(warning.category is DataWarning for warning in told) == (path.name == PREVIOUS)
        fallbacks += path.name == PREVIOUS
    assert fallbacks > 20


def test_a_log_with_lost_rows_is_told(run):
    """Whatever stands there instead of one, the rest is kept."""
    run(*OPTIMIZE, "--iterations", "4")
    log = Path("out/loss.csv")
    header, _, *rows = log.read_text().splitlines()
    for damaged in ("", "1", "1x", "1,0.5,nonsense,0.1,,3,4,120,0.1,0,,", "1,\0", "70000"):
        log.write_text("\n".join([header, damaged, *rows, ""]))
        assert run(*RESUME, "--iterations", "4").stderr == (
            "warning: out/loss.csv: has 3 of the 4 iterations made\n"
        )
        assert iterations() == [2, 3, 4]


CHANGES = {
    "views.1.camera.fov=31": "views.1.camera.fov is 30.0 there, 31.0 now",
    "optimize.parameters.g.min=0": "optimize.parameters.g.min is absent there, 0.0 now",
    "views.0.camera.up=[1,1,0]": "views.0.camera.up is [0.0, 1.0, 0.0] there, [1.0, 1.0, 0.0] now",
    "--dtype": '--dtype is "float32" there, "float64" now',
}


def test_what_has_changed_is_named(run, folder):
    run(*OPTIMIZE, "--iterations", "1")
    for change, difference in CHANGES.items():
        options = [change, "float64"] if change.startswith("-") else ["-D", change]
        result = run(*RESUME, *options)
        line = "out/checkpoints/last.pt: belongs to another scene; use another output folder"
        assert (result.exit_code, result.stderr) == (2, f"{line}: {difference}\n")
    np.save("side.npy", 2 * np.load("side.npy"))
    result = run(*RESUME)
    assert result.exit_code == 2 and f"the content of {folder / 'side.npy'} is" in result.stderr


def test_few_of_many_differences_are_named():
    """An empty section is one."""
    with pytest.raises(UsageError, match=r"^other: g is absent there, {} now$"):
        require_same({"a": {}}, {"a": {}, "g": {}}, "other")
    with pytest.raises(UsageError) as error:
        require_same(dict.fromkeys("abcdefghijkl", 0), dict.fromkeys("abcdefghijkl", 1), "other")
    assert len(error.value.problems) == MOST_CHANGES + 1
    assert error.value.problems[-1] == f"other: {12 - MOST_CHANGES} more differ"


def test_a_state_of_the_wrong_form_is_refused(run):
    run(*OPTIMIZE, "--iterations", "1")
    path = Path("out/checkpoints/last.pt")
    content = torch.load(path, weights_only=True)
    del content["state"]["frames"][0]["parameters"]["density"]
    torch.save(content, path)
    result = run(*RESUME)
    assert (result.exit_code, result.stderr) == (
        3,
        f"{path}: not a usable checkpoint; start anew with --overwrite\n",
    )


def test_checkpoints_are_written_along_the_way(run, monkeypatch):
    """As often as they are to be, unless they take more than their share of the time."""
    saved: list[int] = []
    original = job.save_checkpoint

    def save(folder, state, *scene):
        saved.append(state["frames"][0]["total"]["iteration"])
        original(folder, state, *scene)

    monkeypatch.setattr(job, "save_checkpoint", save)
    monkeypatch.setattr("ddrecon.run.job.CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("ddrecon.run.job.CHECKPOINT_SHARE", 1e9)
    run(*OPTIMIZE, "--iterations", "4")
    assert saved == [0, 1, 2, 3, 4]
    saved.clear()
    monkeypatch.setattr("ddrecon.run.job.CHECKPOINT_SHARE", 1e-9)
    run(*OPTIMIZE, "--iterations", "4", "--overwrite")
    assert saved == [0, 4]
