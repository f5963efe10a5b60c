"""Every command line of the README and the documentation runs, in order, on fewer cells."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ddrecon import bench
from ddrecon.bench import CASES
from ddrecon.cli.commands import main
from ddrecon.io.volumes.table import write_field
from ddrecon.reconstruct.setup import scene_at_level

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_directions")]

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands(page):
    """Every `ddrecon ...` in a code block of `page`."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?:bash|sh|console)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    parts = [
        part.strip() for block in blocks for line in block.splitlines() for part in line.split("&&")
    ]
    return [part for part in parts if part.startswith("ddrecon ")]


def fewer_cells(scene):
    """Overrides that leave `scene` about 5 cells along its shortest side, where it has a number."""
    found = re.search(
        r"^  resolution: \[(\d+), (\d+), (\d+)\]",
        Path(scene).read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    sizes = [int(size) for size in found.groups()] if found else []
    return (
        ["-D", f"volume.resolution={[size * 5 // min(sizes) for size in sizes]}"] if sizes else []
    )


ONE, NO_ROUNDS = ["-D", "volume.density=1"], ["-D", "diffusion.transport_rounds=0"]
ONE_PARAMETER = ["--samples", "2", "-D", "optimize={parameters: {lights.0.direction: {}}}"]


def quick(command):
    """The arguments of `command`, and those that make it quick."""
    _, name, *rest = shlex.split(command, comments=True)
    added = {
        "optimize": ["--iterations", str(1 + ("--resume" in rest)), *NO_ROUNDS],
        "render": ["--size", "32", "24", *(["--ring", "2"] if "--ring" in rest else [])],
        "reference": ["--spp", "4"],
        "gradcheck": [*ONE_PARAMETER, *NO_ROUNDS, "-D", "ground=null"],
    }.get(name, [])
    if rest[0].startswith("configs"):
        is_empty = name in ("render", "bench") and ".vdb" not in command
        added += fewer_cells(rest[0]) + (ONE if is_empty else [])
    return [name, *rest, *added]


def few(variants):
    return lambda *scene: dict([*variants(*scene).items()][:3])


def coarse(load):
    return lambda *arguments: [scene_at_level(scene, 4) for scene in load(*arguments)]


@pytest.fixture
def surroundings(tmp_path, monkeypatch):
    """A folder with configs and data, and a cloud; few hard cases; a bench of few cells."""
    monkeypatch.chdir(tmp_path)
    for name in ("configs", "data"):
        (tmp_path / name).symlink_to(ROOT / name)
    box = np.array([[-200.0, -70, -300], [200, 210, 210]])
    write_field(tmp_path / "wdas_cloud_sixteenth.vdb", "density", np.ones((6, 5, 4)), box)
    for name in list(CASES)[2:]:
        monkeypatch.delitem(CASES, name)
    monkeypatch.setattr(bench, "load_pair", coarse(bench.load_pair))
    monkeypatch.setattr(bench, "QUICK_PATHS", (1, 2))
    monkeypatch.setattr(bench, "variants_of", few(bench.variants_of))


@pytest.mark.parametrize("page", list(filter(commands, PAGES)), ids=lambda page: page.stem)
def test_the_commands_of_a_page_run(page, surroundings):
    for command in commands(page):
        if command.startswith("ddrecon reference"):
            pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (extra `reference`)")
        result = CliRunner().invoke(main, quick(command))
        assert result.exit_code == 0, f"{command}: {result.output}"


def test_the_python_of_its_page_runs(monkeypatch):
    """Block after block, as somebody would paste them; of training, few steps."""
    monkeypatch.chdir(ROOT)
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert blocks
    exec("\n".join(blocks).replace("range(100)", "range(2)"), {})
