"""Files whose names are no UTF-8 are used where that can be, and else refused in a line."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from ddrecon.io.images.oiio import write_exr

Run = Callable[..., Result]
Refuse = Callable[..., list[str]]
STRANGE = os.fsdecode(b"caf\xe9")


@pytest.fixture
def strange(folder: Path) -> Path:
    """The folder of the scene, under such a name."""
    files = [path for path in folder.iterdir() if path.is_file()]
    (folder / STRANGE).mkdir()
    for file in files:
        shutil.copy(file, folder / STRANGE / f"{STRANGE[-1]}{file.name}")
        shutil.copy(file, folder / STRANGE)
    return folder


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("render scene.yaml -o {}/out", "out/ddrecon.manifest: cannot be written: its name is not"),
        (
            "export scene.yaml -o {}/smoke.vdb",
            "smoke.vdb: cannot be written: its name is not UTF-8",
        ),
        ("optimize {}/scene.yaml -o out -q", "front.npy: cannot be named in scene.yaml"),
        ("info {}/a.exr", "a.exr: cannot be read: its name is not UTF-8; rename it"),
    ],
)
def test_what_cannot_be_is_refused(
    strange: Path, refuse: Refuse, command: str, reason: str
) -> None:
    if ".exr" in command:
        pytest.importorskip("OpenImageIO")
        write_exr(strange / "a.exr", np.ones((4, 4, 3), np.float32))
        shutil.move(strange / "a.exr", strange / STRANGE)
    (line,) = refuse(3, *command.format(STRANGE).split())
    assert reason in line and line.isprintable()
