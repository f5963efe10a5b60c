"""What a user can get wrong: one line a problem, the exit code of its kind, and nothing written."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import Result
from image_files import write_exr

from ddrecon.io.volumes.table import write_field

Refuse = Callable[..., list[str]]

COMMANDS = {
    "render": ["render", "scene.yaml", "-o", "out"],
    "optimize": ["optimize", "scene.yaml", "-o", "out"],
    "gradcheck": ["gradcheck", "scene.yaml"],
    "reference": ["reference", "scene.yaml", "-o", "out"],
    "export": ["export", "scene.yaml", "-o", "out.xml"],
    "check": ["check", "scene.yaml"],
}
AN_OUTPUT = ["render", "optimize"]

EDITS = {
    "wrong key": (
        "sigma_s:",
        "sigma_S:",
        ["6:3: volume.sigma_S: unknown key; did you mean 'sigma_s'?", "missing key 'sigma_s'"],
    ),
    "missing image": ("front.npy", "gone.npy", ["views.0.image: gone.npy does not exist"]),
    "missing volume": (
        "density: 0.2",
        "density: {file: gone.npz}",
        ["4:19: volume.density.file: gone.npz does not exist"],
    ),
    "blind camera": (
        "target: [0, 0, 0]",
        "target: [9, 0, 2.5]",
        ["views.0.camera: no pixel of view 'front' looks through the volume"],
    ),
    "size of a field": (
        "resolution: [6, 5, 4]\n  density: 0.2",
        "resolution: [4, 5, 6]\n  density: {file: density.npz}",
        [
            "volume.density.file: has 6 x 5 x 4 cells in x, y, z, "
            "but volume.resolution has 4 x 5 x 6"
        ],
    ),
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_wrong_scene_is_refused(refuse: Refuse, edit: str) -> None:
    scene, (right, wrong, expected) = Path("scene.yaml"), EDITS[edit]
    text = scene.read_text()
    scene.write_text(text.replace(right, wrong, 1))
    assert scene.read_text() != text
    lines = refuse(2, *COMMANDS["check"])
    assert len(lines) == len(expected)
    assert all(line.startswith("scene.yaml:") for line in lines)
    for part in expected:
        assert any(part in line for line in lines), lines


def test_every_missing_file_is_told_at_once(refuse: Refuse) -> None:
    lines = refuse(
        2,
        *COMMANDS["render"],
        "-D",
        "volume.density={file: gone.npz}",
        "-D",
        "views.0.image=gone.npy",
    )
    assert (
        len(lines) == 2
        and "gone.npz does not exist" in lines[0]
        and "gone.npy does not exist" in lines[1]
    )


def test_unreadable_files_are_told_at_once(refuse: Refuse) -> None:
    for name in ("one.npy", "two.npy"):
        Path(name).write_bytes(b"no picture")
    lines = refuse(
        3, *COMMANDS["render"], "-D", "views.0.image=one.npy", "-D", "views.1.image=two.npy"
    )
    assert [line.split(":")[0] for line in lines] == ["one.npy", "two.npy"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_scenes_and_data(refuse: Refuse, command: str) -> None:
    """None at all, one that is wrong, and one whose data is."""
    words = COMMANDS[command]
    for scene, what in (
        ("gone.yaml", "cannot be read: No such file or directory"),
        (".", "holds no result.yaml"),
    ):
        (line,) = refuse(2, *(scene if word == "scene.yaml" else word for word in words))
        assert line.startswith(f"{scene}: {what}")
    (line,) = refuse(2, *words, "-D", "volume.g=2")
    assert line == "-D volume.g=2: volume.g: must be below 1, found 2"
    (line,) = refuse(3, *words, "-D", "views.0.camera.resolution=[8, 8]")
    assert line == "front.npy: is 8 x 6 pixels, but views.0.camera has 8 x 8"


def spoil_image(name: str) -> None:
    pixels = np.load("front.npy")
    pixels[3, 4, 1] = np.nan
    if name.endswith(".exr"):
        write_exr(Path(name), "RGB", pixels)
    else:
        np.save(name, pixels)


@pytest.mark.parametrize("name", ["nan.npy", "nan.exr"])
def test_an_image_with_nan(refuse: Refuse, name: str) -> None:
    spoil_image(name)
    (line,) = refuse(3, *COMMANDS["check"], "-D", f"views.0.image={name}")
    assert line.startswith(f"{name}: NaN at row 3, column 4")


def cut(name: str, source: str) -> None:
    data = Path(source).read_bytes()
    Path(name).write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize(
    ("source", "override"),
    [
        ("density.npz", "volume.density={{file: {}}}"),
        ("front.npy", "views.0.image={}"),
        ("front.npy", "views.0.mask={}"),
    ],
)
def test_a_damaged_file(refuse: Refuse, source: str, override: str) -> None:
    name = f"cut_{source}"
    cut(name, source)
    (line,) = refuse(3, *COMMANDS["check"], "-D", override.format(name))
    assert line.startswith(f"{name}: ")


@pytest.mark.parametrize("command", AN_OUTPUT)
def test_a_folder_with_something_in_it(refuse: Refuse, command: str) -> None:
    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    (line,) = refuse(2, *COMMANDS[command])
    assert line == "out: the folder is not empty; choose another, or say --overwrite"


@pytest.mark.parametrize("command", AN_OUTPUT)
def test_a_file_for_a_folder(refuse: Refuse, command: str) -> None:
    Path("out").write_text("mine")
    assert refuse(2, *COMMANDS[command]) == ["out: is a file; name a folder for the output"]
    assert refuse(2, *COMMANDS[command], "--overwrite") == [
        "out: is a file; name a folder for the output"
    ]


def test_unknown_view(refuse: Refuse) -> None:
    assert refuse(2, *COMMANDS["render"], "--view", "back") == [
        "--view back: no such view; known: front, side"
    ]


def test_unknown_parameter(refuse: Refuse) -> None:
    (line,) = refuse(2, *COMMANDS["gradcheck"], "--parameter", "densty")
    assert line == "--parameter densty: the scene has no such number; did you mean 'density'?"


def test_unknown_gradient(refuse: Refuse) -> None:
    (line,) = refuse(2, *COMMANDS["render"], "--gradient", "densty")
    assert line == "--gradient densty: the scene has no number densty; did you mean 'density'?"


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is here")
def test_no_cuda(refuse: Refuse) -> None:
    (line,) = refuse(2, *COMMANDS["check"], "--device", "cuda")
    assert line.startswith("--device cuda: ")


@pytest.mark.parametrize(
    "arguments",
    [
        ["optimize", "scene.yaml"],
        ["render", "-o", "out"],
        ["optimize", "scene.yaml", "-o", "out", "--iterations", "0"],
        ["render", "scene.yaml", "-o", "out", "--threads", "0"],
        ["check", "scene.yaml", "--dtype", "float16"],
        ["paint", "scene.yaml"],
        ["check", "scene.yaml", "--colour"],
    ],
)
def test_usage(refuse: Refuse, arguments: list[str]) -> None:
    assert refuse(2, *arguments)[-1].startswith("Error: ")


def test_nothing_to_optimize(refuse: Refuse) -> None:
    scene = Path("scene.yaml")
    scene.write_text(scene.read_text().partition("optimize:")[0])
    (line,) = refuse(2, *COMMANDS["optimize"])
    assert "optimize: missing section" in line


def test_nothing_to_optimize_from(refuse: Refuse) -> None:
    (line,) = refuse(2, *COMMANDS["optimize"], "-D", "views.0.split=test")
    assert "none has split: train and an image" in line


def test_resume_without_a_folder(refuse: Refuse) -> None:
    assert refuse(2, *COMMANDS["optimize"], "--resume") == [
        "out/checkpoints/last.pt: there is no checkpoint to resume from; run without --resume"
    ]


def test_resume_without_a_checkpoint(refuse: Refuse) -> None:
    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    (line,) = refuse(2, *COMMANDS["optimize"], "--resume")
    assert line.startswith("out/checkpoints/last.pt: there is no checkpoint to resume from")


def test_resume_of_another_scene(refuse: Refuse, succeed: Callable[..., object]) -> None:
    succeed(*COMMANDS["optimize"], "--iterations", "1")
    (line,) = refuse(2, *COMMANDS["optimize"], "--resume", "-D", "volume.g=0.1")
    assert "belongs to another scene: volume.g is 0.3 there, 0.1 now" in line


@pytest.mark.parametrize("damage", ["cut", "text", "gone"])
def test_resume_from_damaged_checkpoints(
    refuse: Refuse, succeed: Callable[..., object], damage: str
) -> None:
    succeed(*COMMANDS["optimize"], "--iterations", "1")
    path = Path("out/checkpoints/last.pt")
    for each in (path, path.with_name("previous.pt")):
        if damage == "cut":
            cut(str(each), str(each))
        elif damage == "text":
            each.write_text("no checkpoint")
    if damage == "gone":
        shutil.rmtree(path.parent)
        path.parent.mkdir()
    (line,) = refuse(2 if damage == "gone" else 3, *COMMANDS["optimize"], "--resume")
    assert re.match(f"{path.parent}/(last|previous).pt: ", line)


@pytest.mark.parametrize("command", ["render", "gradcheck"])
def test_a_solve_that_diverges(run: Callable[..., Result], folder: Path, command: str) -> None:
    values = np.zeros((4, 5, 6))
    values[1:3, 1:4, 1:4] = 1
    write_field(Path("block.npz"), "density", values, np.array([[-0.5] * 3, [0.5] * 3]))
    dense_block = ["-D", "volume.density={file: block.npz}", "-D", "volume.sigma_s=2000"]
    result = run(*COMMANDS[command], *dense_block, "-D", "diffusion.scheme=printed")
    (line,) = result.stderr.splitlines()
    assert (result.exit_code, result.stdout) == (4, "")
    assert re.search(
        r"kappa changes by a factor \d+\.\d between neighbors at cell \(\d, \d, \d\)"
        r".*diffusion\.scheme=conservative",
        line,
    )


def test_debug_shows_where_an_error_comes_from(run: Callable[..., object]) -> None:
    from ddrecon.errors import SceneError

    with pytest.raises(SceneError, match="must be below 1"):
        run(*COMMANDS["check"], "--debug", "-D", "volume.g=2")


@pytest.mark.parametrize("seed", ["-99999999999999999999", "99999999999999999999999"])
def test_a_seed_that_no_generator_takes(refuse: Refuse, seed: str) -> None:
    assert f"{seed} is not in the range" in refuse(2, *COMMANDS["check"], "--seed", seed)[-1]
