"""What a user can get wrong: one line a problem, the exit code of its kind, and nothing written."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from small_scene import SCENE

from ddrecon.errors import SceneError
from ddrecon.io.files.folders import FILM, MANIFEST
from ddrecon.io.volumes.table import write_field

COMMANDS = "render scene.yaml -o out", "optimize scene.yaml -o out", "gradcheck scene.yaml"
COMMANDS += "reference scene.yaml -o out", "export scene.yaml -o out.xml", "check scene.yaml"
CHANGES = {
    "scene.yaml -D volume.g=2": (2, "-D volume.g=2: volume.g: must be below 1, found 2"),
    "gone.yaml": (2, "gone.yaml: cannot be read: No such file or directory"),
    ". ": (2, ".: holds no result.yaml"),
    "scene.yaml -D views.0.camera.resolution=[8,8]": (3, "front.npy: is 8 x 6 pixels, but views"),
}
"""What every command refuses, in place of its scene."""
TABLE = """
render scene.yaml -o full => 2 full: holds notes.txt, which ddrecon did not write; choose another
optimize scene.yaml -o . --overwrite => 2 scene.yaml: was changed and would be replaced; name a c
render scene.yaml -o file => 2 file: is a file; name a folder for the output
optimize scene.yaml -o file --overwrite => 2 file: is a file; name a folder for the output
render scene.yaml -o out --view back => 2 no view 'back'; known: front, side
render scene.yaml -o out --view frnt => 2 no view 'frnt'; did you mean 'front'?
render scene.yaml -o out --gradient densty => 2 --gradient densty: no variable 'densty'; did you m
render scene.yaml -o out --gradient foo => 2 --gradient foo: no variable 'foo'; besides views, the
render scene.yaml -o out --ring 1 => 2 Error: Invalid value for '--ring': 1 is not in the range 2<=x
render scene.yaml -o out --ring 99999 => 2 Error: Invalid value for '--ring': 99999 is not in the
render scene.yaml -o out --ring 3 --fps nan => 2 Error: Invalid value for '--fps': 'nan' is not a
render scene.yaml -o out --movie m.avi => 2 --movie m.avi: expected a name that ends in .mp4 or .png
render scene.yaml -o out --movie no/m.png => 2 no/m.png: there is no folder
render scene.yaml -o out --movie mine.png => 2 mine.png: already there; choose another name, or
render scene.yaml -o out --overwrite --movie full.png => 2 --movie full.png: is a folder
render scene.yaml -o out --movie out/../out/side.png => 2 --movie out/../out/side.png: is named
render scene.yaml -o out --components --movie out/side.single.png => 2 --movie out/side.single.png:
render scene.yaml -o out --ring 3 --view side --view front => 2 Error: --ring goes around from one
render film -o out --movie m.png => 2 Error: --movie is of one frame: name it, such as FILM/frames
render scene.yaml -o out --light '{type: sun}' => 2 --light {type: sun}: lights.0.type: expected
render -o out => 2 Error: Missing argument 'SCENE'
optimize scene.yaml => 2 Error: Missing option '-o'
optimize scene.yaml -o out --iterations 0 => 2 --iterations 0: optimize.iterations: must
optimize scene.yaml -o out --iterations some => 2 --iterations some: optimize.iterations:
optimize plain.yaml -o out => 2 plain.yaml: optimize: missing section
optimize done -o out => 2 done: a finished run leaves nothing to optimize; name its scene, done/sc
optimize done/result.yaml -o out --iterations 9 => 2 done/result.yaml: a finished run leaves noth
optimize film -o out => 2 film: is the folder of a film; name that of a frame, such as film/frames/
optimize scene.yaml -o out -D views.0.split=test => 2 scene.yaml: views: none has split: train and
optimize scene.yaml -o out -D 'optimize.parameters={views.side.camera: {}}' => 2 scene.yaml: op
optimize scene.yaml -o out --resume --overwrite => 2 Error: --resume goes on with what --overwrite
optimize scene.yaml -o out --resume => 2 out/checkpoints/last.pt: there is no checkpoint to resume
optimize scene.yaml -o full --resume => 2 full: no ddrecon.manifest says who wrote notes.txt; if dd
check full => 2 full: holds no result.yaml, as `ddrecon optimize` writes it at its end; name a
check begun => 2 begun: holds no result.yaml, as `ddrecon optimize` writes it at its end; finish
check film => 2 film: is the folder of a film; name that of a frame, such as film/frames/0003
gradcheck scene.yaml --parameter densty => 2 --parameter densty: the scene has no such number; did
gradcheck scene.yaml --json gone/report.json => 2 gone/report.json: there is no folder
check gone.yaml --json gone/report.json => 2 gone/report.json: there is no folder
check scene.yaml --dtype float16 => 2 Error: Invalid value for '--dtype'
check scene.yaml --threads 0 => 2 Error: Invalid value for '--threads'
check scene.yaml --seed 99999999999999999999999 => 2 Error: Invalid value for '--seed'
check scene.yaml --colour => 2 Error: No such option
paint scene.yaml => 2 Error: No such command 'paint'
bench -q -D volume.g=0 => 2 Error: -D changes a scene file; name one
bench -q --hard scene.yaml => 2 Error: --hard has cases of its own
bench gone.yaml => 2 gone.yaml: cannot be read
bench -q --hard -o scene.yaml => 2 scene.yaml: is a file
reference scene.yaml -o out --spp 3 => 2 Error: Invalid value for '--spp'
export density.npz -o smoke.obj => 2 -o smoke.obj: unknown format '.obj'; known: .xml, .json
export density.npz -o smoke.xml => 2 Error: density.npz: is no scene, and .xml is written of one
export density.npz -o smoke.nc => 2 -o smoke.nc: unknown format '.nc'; known: .xml, .json
export scene.yaml scene.yaml -o smoke.xml => 2 Error: one scene at a time is written as .xml
export scene.yaml -o a.xml --up z => 2 Error: --up z turns volumes only
export scene.yaml -o none/smoke.xml => 2 none/smoke.xml: there is no folder
export film -o a.vdb => 2 film: is the folder of a film; name that of a frame, such as film/frames/
info film => 2 film: is the folder of a film; name that of a frame, such as film/frames/0003
info density.npz -D volume.g=0 => 2 Error: -D changes a scene file; name one
export density.npz -o a.vdb -D volume.g=0 => 2 Error: -D changes a scene file; name one
export gone.vol -o a.vdb => 2 gone.vol: cannot be read
import gone.xml -o a.yaml => 2 gone.xml: cannot be read
info front.txt => 3 front.txt: unknown image format '.txt'
info bad.npz => 3 bad.npz: is damaged: File is not a zip file
info gone.vol => 2 gone.vol: cannot be read
uncertainty gone -o sure => 2 gone: cannot be read
uncertainty film -o sure => 2 film: is the folder of a film; name that of a frame, such as film/fr
uncertainty full -o ./full => 2 full: holds no run
"""


def rows():
    """A command, its exit code and how its last line begins."""
    parts = [row.partition(" => ") for row in TABLE.strip().split("\n")]
    return [(command, int(told[0]), told[2:]) for command, _, told in parts]


@pytest.mark.parametrize(("command", "code", "line"), rows())
def test_what_cannot_be_done_is_refused(folder, refuse, command, code, line):
    del folder
    Path("plain.yaml").write_text(SCENE.partition("optimize:")[0])
    texts = dict.fromkeys(["full/notes.txt", "file", "front.txt", "bad.npz", "mine.png"], "mine")
    runs = "done/scene.yaml", "done/result.yaml", "film/frames/0003/result.yaml", "begun/scene.yaml"
    texts |= dict.fromkeys(runs, SCENE) | {"begun/loss.csv": ""}
    texts |= {f"film/{MANIFEST}": f"ddrecon {FILM}\n"}
    Path("full.png").mkdir()
    for name, text in texts.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text)
    assert refuse(code, *shlex.split(command))[-1].startswith(line)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_scenes_and_data(refuse, command):
    for change, (code, expected) in CHANGES.items():
        (line,) = refuse(code, *shlex.split(command.replace("scene.yaml", change)))
        assert line.startswith(expected)


def test_everything_is_told_at_once(refuse):
    Path("one.npy").write_bytes(b"no picture")
    Path("two.npy").write_bytes(b"no picture")
    gone = "-D", "volume.density={file: gone.npz}", "-D", "views.0.image=gone.npy"
    assert ["gone.npz" in line for line in refuse(2, "check", "scene.yaml", *gone)] == [True, False]
    damaged = "-D", "views.0.image=one.npy", "-D", "views.1.image=two.npy"
    lines = refuse(3, "check", "scene.yaml", *damaged)
    assert [line.split(":")[0] for line in lines] == ["one.npy", "two.npy"]


def test_a_run_does_not_go_on_with_less(refuse, succeed):
    """With fewer iterations, or from checkpoints that are all damaged."""
    again = "optimize", "scene.yaml", "-o", "out", "--iterations", "2"
    succeed(*again)
    (line,) = refuse(2, *again[:-1], "1", "--resume")
    assert "2 iterations are made already" in line
    path = Path("out/checkpoints/last.pt")
    files = path, path.with_name("previous.pt")
    for damage in (lambda data: data[: len(data) // 2], lambda _: b"no checkpoint"):
        for each in files:
            each.write_bytes(damage(each.read_bytes()))
        (line,) = refuse(3, *again, "--resume")
        assert re.match(f"{path.parent}/(last|previous).pt: ", line)


@pytest.mark.parametrize("command", ["render scene.yaml -o out", "gradcheck scene.yaml"])
def test_a_solve_that_diverges(run, command):
    values = np.zeros((4, 5, 6))
    values[1:3, 1:4, 1:4] = 1
    write_field(Path("block.npz"), "density", values, np.array([[-0.5] * 3, [0.5] * 3]))
    dense_block = ["-D", "volume.density={file: block.npz}", "-D", "volume.sigma_s=2000"]
    result = run(*command.split(), *dense_block, "-D", "diffusion.scheme=printed")
    (line,) = result.stderr.splitlines()
    assert (result.exit_code, result.stdout) == (4, "")
    told = r"kappa changes .* the largest is \d+\.\d at cell \(\d, \d, \d\)"
    assert re.search(told + r".*diffusion\.scheme=conservative", line)


def test_debug_shows_where_an_error_comes_from(run):
    with pytest.raises(SceneError, match="must be below 1"):
        run("check", "scene.yaml", "--debug", "-D", "volume.g=2")
