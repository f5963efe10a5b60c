"""What is wrong with a scene is one line: the place, the key, what to do; one table of it all."""

import numpy as np
import pytest
from example_scene import SCENE

from ddrecon.errors import FormatError, SceneError
from ddrecon.io.volumes.table import write_fields
from ddrecon.scene_file.build import load_scene

BOX = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
MEDIA = "volume={bounds: {min: [0, 0, 0], max: [1, 1, 1]}, resolution: [1, 1, 1], media: "
MEDIUM = "{density: 1, sigma_t: 1, albedo: 1}"
FLAT = "views.0.camera={type: orthographic, width: 2, resolution: [4, 4], matrix: "
INSIDE = "& views.0.camera.origin=[0, 0.1, 0.2]"
RING = "views={ring: {count: 3, radius: 3, fov: 30, resolution: [8, 6]}"
"""What rows of the table begin with, which close the brace themselves."""

SCENES = f"""
volume.g=.nan => volume.g: expected a finite number
volume.g=2 => -D volume.g=2: volume.g: must be below 1, found 2
volume.density=[1, 2, 3] => {{file: ...}}, {{heights: ...}} or {{labels: ...}}, found a list of 3
volume.density={{constant: -1}} => volume.density.constant: must be at least 0
volume.density={{constant: 1, file: a.npz}} => volume.density.constant: unknown key
volume.density={{file: 3}} => density.file: expected a file, found 3 (put it in quotes)
volume.density={{file: "a\\0"}} => volume.density.file: expected text that can be printed
volume.density={{file: {"n" * 5000}}} => -D volume.density={{file: nnn
volume.sigma_a=[1, 2] => [r, g, b], {{file: ...}}, {{heights: ...}} or {{labels: ...}}, found a list
volume.density={{heights: [0, 0], values: [1, 2]}} => heights: must go up from one to the next
volume.density={{heights: [0, 1], values: [1]}} => density.values: expected one for each height, 2
volume.density={{heights: [0], values: [-1]}} => volume.density.values: must be at least 0
volume.density={{labels: two.npz, table: [1, 2]}} => density.table: expected one for each label, 3
volume.density={{labels: two.npz, table: [1, 2, -3]}} => volume.density.table: must be at least 0
volume.density={{labels: two.npz, table: [1, 2, [1, 2, 3]]}} => expected numbers: colors
volume.media={{a: {MEDIUM}}} => volume: give only one of density or media
volume.density={{file: a.npz, labels: two.npz}} => density: give only one of file or labels
volume.albedo=0.5 => volume: give only one of sigma_a and sigma_s or sigma_t and albedo
volume={{density: 1}} => volume: missing sigma_a and sigma_s or sigma_t and albedo
volume={{density: 1, sigma_t: 1, albedo: ~}} => volume: missing key 'albedo'
volume={{density: 1, sigma_t: 1, albedo: 1, resolution: [1, 1, 1]}} => missing key 'bounds'
volume={{density: {{file: boxless.npz}}, sigma_t: 1, albedo: 1}} => missing key 'bounds'
volume.resolution=~ => volume: missing key 'resolution', which no field file gives either
volume.resolution=[2, 0, 2] => volume.resolution.1: must be at least 1
volume.resolution=[4096, 4096, 4096] => volume.resolution: 6.9e+10 cells are too many
volume.bounds.max=[0.5, -0.75, 1] => volume.bounds.max: -0.75 along y is not above min, -0.75
volume.density={{file: wide.npz}} => has the resolution 3 x 2 x 2, but volume.resolution has
volume.density={{file: moved.npz}} => density.file: has the bounds (-1, -1.5, -1) to (1, 1.5, 1)
volume=3 => volume: expected a mapping, found 3
volume.periodic=[x,x] => volume.periodic: name one axis or two
volume.periodic=[w] => volume.periodic.0: expected one of x, y, z
ground={{height: 0, albedo: 0.3}} => ground.height: 0 is above the bottom of the box, -0.75 along y
ground={{height: -2, albedo: 1.1}} => ground.albedo: must be at most 1, found 1.1
volume.index=1.4 {INSIDE} => volume.index: there is none with a camera inside
volume.phase={{type: rayleigh}} => volume.phase: g is short for a phase function: give only one
volume={{density: 1, sigma_t: {{meters: 1}}, albedo: 1}} => volume.sigma_t: meters are for droplets
volume.effective_radius=1 => volume.effective_radius: is that of droplets, phase: {{type: mie, ...}}
volume.phase={{type: two_lobes}} => did you mean 'two_lobe'?
{MEDIA}{{cloud: {MEDIUM}}}}} => volume.media: expected two media, found 1
{MEDIA}{{cloud: {MEDIUM}, the air: {MEDIUM}}}}} => volume.media: 'the air' is no name
{MEDIA}{{cloud: {MEDIUM}, air: {{density: 1}}}}}} => volume.media.air: missing sigma_a and sigma_s
{MEDIA}{{a: {MEDIUM}, b: {MEDIUM[:-1]}, phase: {{type: two_lobe}}}}}}}} => expected one of henyey
{MEDIA}{{a: {MEDIUM}, b: {MEDIUM[:-1]}, g: {{file: g.npz}}}}}}}} => media.b.g: expected a number
lights=[] => lights: there is none, and the volume has no emission
lights=[{{radiance: 1}}] => lights.0: missing key 'type', one of directional, ambient,
lights=[{{type: ambien, radiance: 1}}] => found 'ambien'; did you mean 'ambient'?
lights=[{{type: point, position: [0, 1], intensity: 1}}] => position: expected a list of 3 numbers
lights.0.direction=[0, 0, 0] => lights.0.direction: must not be zero
optimize.iterations=3x => optimize.iterations: expected a whole number or auto, found '3x'
volume.bounds=wide => volume.bounds: expected a mapping or auto, found 'wide'
views=[] => views: expected a list with at least one entry
views=ring => views: expected a list with at least one entry or a mapping, found 'ring'
views={{images: "*.exr"}} => views: missing ring or transforms or colmap
{RING}, image: "*.exr"}} => views.image: unknown key; did you mean 'images'?
{RING}, images: "*.npz"}} => views.images: '*.npz' matches 6 files, but the ring has 3 cameras
{RING}, transforms: t.json}} => views: give only one of ring or transforms
views={{ring: {{count: 3, radius: 1, fov: 30}}}} => views.ring: missing key 'resolution'
views={{transforms: gone.json}} => views.transforms: gone.json does not exist, or is not a file
views={{transforms: t.json, images: "*.png"}} => views.images: is for a ring or COLMAP
views={{colmap: gone}} => colmap: missing key 'images', the folder of its pictures
views.0.name= => views.0.name: expected text, found nothing
views.0.name='a b' => views.0.name: 'a b' is not a file name
views.0.name={"n" * 201} => views.0.name: '{"n" * 201}' is not a file name
views.0.name=front.single => views.0.name: 'front.single' ends in .single
views.0.camera.resolution=~ => views.0.camera: missing key 'resolution'
views.0.camera={{type: orthographic, origin: [0, 0, 1], target: [0, 0, 0]}} => missing key 'width'
views.0.camera={{type: perspective, fov: 30}} => views.0.camera: missing matrix or origin and target
views.0.camera={{type: perspective, fov: 30, target: [0, 0, 0]}} => missing key 'origin'
views.0.camera.matrix=[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]] => give only one of matrix or origin
{FLAT}[[0,0,1.001,2],[0,1,0,0],[-1,0,0,0],[0,0,0,1]]}} => camera.matrix: must be rigid: its first
{FLAT}[[0.01,0,1,2],[0,1,0,0],[-1,0,0,0],[0,0,0,1]]}} => of unit length and perpendicular
{FLAT}[[0,0,1,2],[0,1,0,0],[-1,0,0,0],[0,0,0,2]]}} => its last row must be [0, 0, 0, 1]
{FLAT}[[0,0,1,2],[0,-1,0,0],[-1,0,0,0],[0,0,0,1]]}} => it mirrors (determinant -1)
views.0.camera.target=[0, 0.3, 3.2] => views.0.camera: origin, target and up do not span a view
render.samples_per_pixel=true => samples_per_pixel: expected a whole number, found true
render={{background: true, background: true}} => render.background: repeated key
diffusion.model=p2 => diffusion.model: expected one of none, p1, flux_limited, found 'p2'
diffusion={{model: flux_limited, scheme: printed}} => 'printed' is for diffusion.model p1
diffusion.degree=4 => diffusion.degree: expected one of 1, 3, 5, 7, found 4
diffusion={{model: flux_limited, transport_rounds: 1}} => rounds begin at model p1 with scheme
difusion.model=p1 => difusion: unknown key; did you mean 'diffusion'?
optimize.optimizer=adam => optimize.optimizer: unknown key; known: parameters, iterations, loss,
optimize.parameters={{}} => optimize.parameters: names no parameter; known: density
optimize.loss=l3 => optimize.loss: expected one of l2, l1, huber, relative_l2, display, photon
optimize.parameters.densty={{}} => parameters.densty: unknown parameter; did you mean 'density'?
optimize.parameters.media.cloud.g={{field: true}} => it is not a field, so it has none
optimize.parameters.phase.g={{}} => parameters.phase.g: no variable
optimize.parameters.density.support=0.1 => density.support: expected one of masks, auto
optimize.parameters.g.support=auto => g.support: 'auto' is for density alone
optimize.parameters.density={{min: 2, max: 1}} => density.max: 1 is not above min, 2
optimize.parameters.density={{init: 3, max: 1}} => density.init: 3 is not between min and max
optimize.parameters.albedo={{init: 1.5}} => albedo.init: must be at least 0 and at most 1, found 1.5
optimize.parameters.sigma_s={{init: [1, 2]}} => expected one number or [r, g, b], found a list of 2
optimize.parameters.sigma_a={{init: {{file: wide.npz}}}} => has [2, 2, 3] cells [z, y, x], but
optimize.parameters.sigma_a={{init: {{file: cells.npz}}, field: false}} => differs from cell to cell
optimize.parameters={{albedo: {{}}, sigma_s: {{}}}} => albedo: cannot be optimized beside sigma_s
optimize.parameters.lights.7.irradiance={{}} => did you mean 'lights.0.irradiance'?
optimize.parameters.lights.0.direction={{init: 3}} => direction.init: expected a list of 3 numbers
optimize.parameters.lights.0.direction={{init: [0, 0, 0]}} => direction.init: must not be zero
optimize.parameters.lights.0.irradiance={{init: {{file: cells.npz}}}} => irradiance is not a field
optimize.parameters.views.back.camera={{}} => did you mean 'views.front.camera'?
volume.g => -D volume.g: expected key.path=value
=3 => -D =3: expected key.path=value
volume.g.x=3 => -D volume.g.x=3: volume.g.x: volume.g is 0.3, not a mapping or list
lights.x=3 => lights.x: no such entry: lights is a list of 2, counted from 0
volume.g=[1 => -D volume.g=[1: not YAML: while parsing a flow sequence, did not find
volume.g=*x => -D volume.g=*x: aliases such as *name are not supported
"""
"""Overrides of the small scene, and what its one line says: the user mends the scene."""

FILES = """
volume.density={file: junk.npz} => junk.npz: is damaged: File is not a zip file
volume.density={file: cells.npz, name: rain} => cells.npz: has no field 'rain'; it has
volume.density={file: cells.npz, name: colors} => colors belong to the cross sections
volume.density={file: cells.npz, name: below} => below is below 0 at cell (x, y, z) = (0, 0, 0)
volume={density: 1, sigma_t: 1, albedo: {file: cells.npz, name: two}} => two is above 1 at cell
volume.g={file: cells.npz, name: steep} => steep is above 0.99 at cell (x, y, z) = (0, 0, 0)
volume.density={labels: cells.npz, name: density, table: [1]} => density are not whole numbers
views.0.image=nan.npy => nan.npy: NaN at row 0, column 0
views.0.image=sky.npy => sky.npy: is 6 x 4 pixels, but views.0.camera has 8 x 6
views.0.mask=sky.npy => sky.npy: is 6 x 4 pixels, but views.0.camera has 8 x 6
lights=[{type: environment, file: narrow.npy}] => at least 3 x 2 pixels, and this is 2 x 4
views={transforms: bad.json} => bad.json: not JSON
"""
"""The same where a file is to blame."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the scene, and files that are good or bad in one way each."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.yaml").write_text(SCENE)
    cells = np.random.default_rng(0).uniform(0.1, 0.9, (4, 3, 2))
    fields = {"density": cells, "sigma_a": cells, "steep": cells + 2, "two": cells + 2}
    fields |= {"colors": np.stack([cells] * 3, -1), "g": cells, "below": cells - 1}
    write_fields(folder / "cells.npz", fields, BOX)
    wide = {"density": np.ones((2, 2, 3)), "sigma_a": np.ones((2, 2, 3))}
    write_fields(folder / "wide.npz", wide, BOX)
    write_fields(folder / "two.npz", {"labels": np.full((4, 3, 2), 2)}, BOX)
    write_fields(folder / "moved.npz", {"density": cells}, 2 * BOX)
    np.savez(folder / "boxless.npz", density=np.ones((2, 2, 2)))
    np.save(folder / "nan.npy", np.full((6, 8, 3), np.nan))
    np.save(folder / "sky.npy", np.ones((4, 6, 3)))
    np.save(folder / "narrow.npy", np.ones((4, 2, 3)))
    (folder / "junk.npz").write_bytes(b"junk")
    (folder / "t.json").write_text("{}")
    (folder / "bad.json").write_text("[" * 10**5)
    return folder


@pytest.fixture(autouse=True)
def in_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)


def rows(table):
    return [
        (override, line)
        for override, _, line in (row.partition(" => ") for row in table.split("\n")[1:-1])
    ]


@pytest.mark.parametrize(("override", "line"), rows(SCENES))
def test_what_is_wrong_with_a_scene(folder, override, line):
    overrides = override.split(" & ")
    if override.startswith("optimize.") and not override.startswith("optimize.parameters={"):
        overrides.insert(0, "optimize={parameters: {density: {}}}")
    with pytest.raises(SceneError) as caught:
        load_scene(folder / "scene.yaml", overrides=overrides)
    (problem,) = caught.value.problems
    assert line in problem.replace(f"{folder}/", "")
    assert problem.startswith(("-D ", f"{folder}/scene.yaml:"))


@pytest.mark.parametrize(("override", "line"), rows(FILES))
def test_what_is_wrong_with_a_file(folder, override, line):
    with pytest.raises(FormatError) as caught:
        load_scene(folder / "scene.yaml", overrides=[override])
    (problem,) = caught.value.lines
    assert line in problem.replace(f"{folder}/", "") and problem.startswith(f"{folder}/")


def test_what_a_field_may_hold_depends_on_what_it_is_used_for(folder):
    """Not on its name in the file: below 0 is no density, but some g."""
    scene = load_scene(folder / "scene.yaml", overrides=["volume.g={file: cells.npz, name: below}"])
    assert float(scene.volume.phase.g.max()) < 0
