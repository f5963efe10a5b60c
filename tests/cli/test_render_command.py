"""What `ddrecon render` writes and says."""

import json
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from small_scene import contents

import ddrecon
from ddrecon.extras import advice
from ddrecon.io.images.films import frame_times, read_frame
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field
from ddrecon.run.render_folder import rounds_text

RENDER = ["render", "scene.yaml", "-o", "out", "-q"]
ROUND = ["-D", "diffusion.transport_rounds=1"]


def pixels(name):
    return np.load(f"out/{name}.npy", allow_pickle=False)


def encoded(linear):
    """8-bit sRGB, written out from IEC 61966-2-1."""
    clipped = linear.clip(0, 1)
    return np.round(
        255 * np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    )


def test_what_a_render_writes_and_says(succeed):
    """Of each view an array, a float picture and a preview in sRGB, and a record of all."""
    pytest.importorskip("OpenImageIO")
    result = succeed(*RENDER, *ROUND, "--json", "-D", "diffusion.tolerance=1e-5")
    report = json.loads(Path("out/render.json").read_text())
    assert json.loads(result.stdout) == report
    files = [f"{name}.{end}" for name in ("front", "side") for end in ("exr", "npy", "png")]
    assert set(contents(Path("out"))) == {"ddrecon.manifest", "render.json", *files}
    assert sorted(file for named in report["files"].values() for file in named) == files
    for name in ("front", "side"):
        image = pixels(name)
        assert (image.shape, image.dtype) == ((6, 8, 3), np.float32)
        assert np.isfinite(image).all() and image.max() > 0
        assert np.array_equal(read_image(Path(f"out/{name}.exr")).pixels, image)
        preview = iio.imread(f"out/{name}.png")
        assert np.abs(preview - encoded(image.astype(float))).max() <= 1
    assert report["seconds"]["light"] >= 0 and set(report["seconds"]["views"]) == {"front", "side"}
    assert [
        solve["iterations"] > 0 and solve["residual"] <= 1e-5
        for solve in report["solves"]
        if solve["kind"] == "forward"
    ] == [True, True]  # diffusion's own, and that of the round
    assert report["rounds"].keys() == {"count", "residual", "tolerance"}
    target = np.load("front.npy").astype(float)
    expected = 10 * np.log10(target.max() ** 2 / np.square(pixels("front") - target).mean())
    assert report["psnr"]["front"] == pytest.approx(expected, abs=1e-3)


def test_no_view_is_named_as_the_files_of_another_one(refuse, succeed):
    """Whatever a render writes beside NAME.exr: NAME.depth is not for a view of its own."""
    succeed(*RENDER, "--components", "--gradient", "density", "--view", "front")
    names = {Path(name).stem for name in contents(Path("out"))} - {"front", "render", "ddrecon"}
    assert {"front.depth", "front.gradient.single"} <= names
    for name in names:
        (line,) = refuse(2, "check", "scene.yaml", "-D", f"views.1.name={name}")
        assert name in line


def test_layers_of_the_exr_put_an_image_over_another(succeed):
    """Image + transmittance times what is behind is the image of a view before it."""
    module = pytest.importorskip("OpenImageIO")
    black = ["-D", "render.background=false", "--view", "front"]
    succeed(*RENDER, *ROUND, *black, "--components")
    file = module.ImageInput.open("out/front.exr")
    names, values = file.spec().channelnames, file.read_image("float")
    layers = dict(zip(names, np.moveaxis(values, -1, 0), strict=True))
    file.close()

    def colors(name):
        return np.stack([layers[f"{name}{color}"] for color in "RGB"], -1)

    through, image = colors("transmittance."), colors("")
    assert np.array_equal(image, sum(map(colors, ("reduced.", "single.", "multiple."))))
    assert np.allclose(layers["A"], 1 - through.mean(-1), atol=1e-6) and layers["A"].max() > 0.1
    depth, is_seen = layers["Z"], layers["A"] > 1e-3
    assert np.array_equal(depth, pixels("front.depth")) and np.isfinite(depth[is_seen]).all()
    camera = ddrecon.load_scene("scene.yaml").view("front").camera
    away = -float(camera.pose[:, 2] @ -camera.pose[:, 3])
    assert np.abs(depth[is_seen] - away).max() < 0.5  # half of the box's side
    target = read_image(Path("front.npy")).pixels
    behind = np.full_like(target, 0.5)
    np.save("behind.npy", behind)
    succeed(*RENDER, *ROUND, *black, "--overwrite", "-D", "views.0.background=behind.npy")
    np.testing.assert_allclose(pixels("front"), image + through * behind, rtol=1e-5)


def test_no_exr_where_openimageio_is_not_installed(succeed, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    result = succeed(*RENDER)
    assert not list(Path("out").glob("*.exr"))
    assert Path("out/front.npy").is_file() and Path("out/front.png").is_file()
    (line,) = [line for line in result.stdout.splitlines() if "OpenImageIO" in line]
    assert "no .exr" in line and "pip install" in line


@pytest.mark.parametrize(("said", "made"), [(0, 0), (1, 2), (3, 3)])
def test_the_fluence_is_a_volume_of_the_scene(succeed, said, made):
    """By two rounds at least, but none where there are to be none; in color where colors differ."""
    rounds, scattering = "diffusion.transport_rounds=", f"volume.sigma_s={[5, 6, 7] if said else 5}"
    told = succeed(*RENDER, "--fluence", "-D", f"{rounds}{said}", "-D", scattering).stdout
    assert "volumes/fluence.npz" in told
    field = read_field(Path("out/volumes/fluence.npz"), "fluence")
    scene = ddrecon.load_scene("scene.yaml", overrides=[f"{rounds}{made}", scattering])
    expected = ddrecon.fluence(scene).permute(1, 2, 3, 0).squeeze(-1)
    np.testing.assert_allclose(field.values, expected.numpy(), rtol=1e-4)
    assert field.values.shape == ((4, 5, 6, 3) if said else (4, 5, 6))
    assert field.bounds is not None and field.bounds.tolist() == [[-0.5] * 3, [0.5] * 3]


@pytest.mark.parametrize(
    ("count", "residual", "tolerance", "verdict"),
    [
        (1, 0.3, None, "what diffusion alone lacks"),
        (3, 0.0099, None, "at rest"),
        (3, 0.011, None, "not at rest"),
        (1, 0.09, 0.1, "at rest"),
        (2, 2e-6, 1e-6, "not at rest"),
        (1, 0.998, None, "what diffusion alone lacks"),  # 99.8 %, not 1e+02 %
    ],
)
def test_it_is_said_whether_light_has_come_to_rest(count, residual, tolerance, verdict):
    words = rounds_text(count, residual, tolerance)
    begin = f"transport rounds: {count}, the last changed light by {100 * residual:.3g} %: "
    assert words.startswith(begin + verdict) and "e+" not in words


def test_a_balance_is_printed_and_a_record(succeed):
    record = json.loads(succeed("balance", "scene.yaml", "--json").stdout)
    assert set(record["enters"]) == {"lights.0", "lights.1"}
    assert set(record["leaves"]) == {sign + axis for sign in "-+" for axis in "xyz"}
    entered = np.array([*record["enters"].values()]).sum(0)
    assert np.allclose(record["fractions"]["absorbed"], record["absorbed"] / entered)
    outflow = np.array([*record["leaves"].values()]).sum(0)
    defect = 100 * (1 - (np.array(record["absorbed"]) + outflow) / entered)
    assert np.allclose(defect, record["defect_percent"])
    assert "neither absorbed nor left" in succeed("balance", "scene.yaml").stdout


def test_another_light_is_as_if_the_scene_had_it(succeed):
    sky = "{type: ambient, radiance: 0.3}"
    lamp = "{type: point, position: [0, 2, 0], intensity: [1, 2, 3]}"
    words = succeed(*RENDER, "--light", sky, "--light", lamp).stdout
    relit = pixels("front")
    succeed(*RENDER, "--overwrite", "-D", f"lights=[{sky}, {lamp}]")
    assert np.array_equal(pixels("front"), relit) and "PSNR" not in words


def test_cameras_of_a_file_at_a_size_without_their_pictures(succeed):
    scene = ddrecon.load_scene("scene.yaml")
    frames = [
        {"transform_matrix": [*view.camera.pose.tolist(), [0, 0, 0, 1]], "file_path": f"no_{n}.png"}
        for n, view in enumerate(scene.views)
    ]
    width = float(scene.views[0].camera.half_width)
    angle = {"camera_angle_x": 2 * float(np.arctan(width))}
    Path("path.json").write_text(json.dumps({**angle, "frames": frames}))
    succeed(*RENDER, "--cameras", "path.json", "--size", "8", "6")
    named = pixels("no_0")
    succeed(*RENDER, "--overwrite")
    np.testing.assert_allclose(named, pixels("front"), rtol=1e-4)


def test_a_size_keeps_what_a_camera_does_to_radiance(succeed):
    """Its own size changes nothing; a background that is a picture is of another size."""
    changes = ["exposure=[1.5, 1, 0.8]", "offset=0.01", "background=0.2", "weight=2"]
    changed = [word for change in changes for word in ("-D", f"views.0.{change}")]
    succeed(*RENDER, *changed)
    before = pixels("front")
    succeed(*RENDER, *changed, "--size", "8", "6", "--overwrite")
    np.testing.assert_array_equal(pixels("front"), before)


def test_a_size_keeps_the_width_of_view(succeed):
    """The mean of twice as many pixels is near the picture of few, and a taller one goes on."""
    succeed(*RENDER, "--view", "front", "--size", "80", "60")
    fine = pixels("front")
    succeed(*RENDER, "--overwrite", "--view", "front", "--size", "80", "100")
    taller = pixels("front")
    assert np.allclose(taller[20:80], fine, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("movie", ["out/ring.png", "m.mp4"])
def test_a_ring_is_a_movie_by_the_exposure_of_its_previews(succeed, monkeypatch, movie):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr("ddrecon.run.render_folder.FEW", 2)
    options = [] if movie.startswith("out") else ["--movie", movie]
    ring = "--ring", "4", "--view", "front", "--size", "33", "21", "--fps", "12"
    words = succeed(*RENDER, *ROUND, *ring, *options).stdout
    assert "transport rounds: 1, " in words
    report = json.loads(Path("out/render.json").read_text())
    names = [f"ring_{number:03d}" for number in range(4)]
    assert list(report["files"]) == names and report["psnr"] == {}
    assert report["movie"]["file"] == movie and f"movie: {movie}" in words
    assert "... 2 views between them" in words and f"{names[2]}: " not in words
    if movie.endswith(".mp4"):
        assert frame_times(Path(movie)) == pytest.approx(np.arange(4) / 12)
        frames = [read_frame(Path(movie), number)[:21, :33] for number in range(4)]
    else:
        frames = [*iio.imread(movie, index=..., plugin="pillow")[..., :3]]
    for frame, name in zip(frames, names, strict=True):
        preview = iio.imread(f"out/{name}.png")
        assert np.abs(frame.astype(float) - preview).mean() < (3 if movie == "m.mp4" else 0.01)
        exposed = encoded(pixels(name) / report["movie"]["white"])
        assert np.abs(preview - exposed).max() <= 1
    succeed(
        "render", "scene.yaml", "-o", "front", "-q", "--view", "front", "--size", "33", "21", *ROUND
    )
    np.testing.assert_allclose(pixels("ring_000"), np.load("front/front.npy"), rtol=1e-4)


def test_a_movie_that_lacks_a_package_is_refused_before_rendering(refuse, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert refuse(3, *RENDER, "--movie", "m.mp4") == [f"m.mp4: {advice('imageio_ffmpeg')}"]
