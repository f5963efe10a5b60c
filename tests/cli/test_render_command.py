"""What `ddrecon render` writes and says."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from small_scene import contents

import ddrecon
from ddrecon.extras import advice
from ddrecon.io.images.films import frame_times, read_frame
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field

Run = Callable[..., Result]
RENDER = ["render", "scene.yaml", "-o", "out", "-q"]
ROUND = ["-D", "diffusion.transport_rounds=1"]


def pixels(name: str) -> np.ndarray:
    return np.load(f"out/{name}.npy", allow_pickle=False)


def encoded(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB, written out from IEC 61966-2-1."""
    clipped = linear.clip(0, 1)
    return np.round(
        255 * np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)
    )


def test_every_view_becomes_an_array_a_float_picture_and_a_preview(succeed: Run) -> None:
    """The preview is sRGB."""
    import imageio.v3 as iio

    pytest.importorskip("OpenImageIO")
    succeed(*RENDER)
    assert set(contents(Path("out"))) == {
        "ddrecon.manifest",
        "render.json",
        *(f"{name}.{end}" for name in ("front", "side") for end in ("exr", "npy", "png")),
    }
    for name in ("front", "side"):
        image = pixels(name)
        assert (image.shape, image.dtype) == ((6, 8, 3), np.float32)
        assert np.isfinite(image).all() and image.max() > 0
        assert np.array_equal(read_image(Path(f"out/{name}.exr")).pixels, image)
        preview = iio.imread(f"out/{name}.png")
        assert np.abs(preview - encoded(image.astype(float))).max() <= 1


def test_layers_of_the_exr_put_an_image_over_another(succeed: Run) -> None:
    """Image + transmittance times what is behind is the image of a view before it."""
    module = pytest.importorskip("OpenImageIO")
    black = ["-D", "render.background=false", "--view", "front"]
    succeed(*RENDER, *ROUND, *black, "--components")
    file = module.ImageInput.open("out/front.exr")
    names, values = file.spec().channelnames, file.read_image("float")
    layers = dict(zip(names, np.moveaxis(values, -1, 0), strict=True))
    file.close()

    def colors(name: str) -> np.ndarray:
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


def test_the_report(succeed: Run) -> None:
    result = succeed(*RENDER, *ROUND, "--json", "-D", "diffusion.tolerance=1e-5")
    report = json.loads(Path("out/render.json").read_text())
    assert json.loads(result.stdout) == report
    assert report["seconds"]["light"] >= 0 and set(report["seconds"]["views"]) == {"front", "side"}
    assert [
        solve["iterations"] > 0 and solve["residual"] <= 1e-5
        for solve in report["solves"]
        if solve["kind"] == "forward"
    ] == [True, True]  # diffusion's own, and that of the round
    named = {file for files in report["files"].values() for file in files}
    assert named | {"ddrecon.manifest", "render.json"} == set(contents(Path("out")))
    target = np.load("front.npy").astype(float)
    expected = 10 * np.log10(target.max() ** 2 / np.square(pixels("front") - target).mean())
    assert report["psnr"]["front"] == pytest.approx(expected, abs=1e-3)


def test_no_exr_where_openimageio_is_not_installed(
    succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    result = succeed(*RENDER)
    assert not list(Path("out").glob("*.exr"))
    assert Path("out/front.npy").is_file() and Path("out/front.png").is_file()
    (line,) = [line for line in result.stdout.splitlines() if "OpenImageIO" in line]
    assert "no .exr" in line and "pip install" in line


def test_the_fluence_is_a_volume_of_the_scene(succeed: Run) -> None:
    assert "volumes/fluence.npz" in succeed(*RENDER, "--fluence").stdout
    field = read_field(Path("out/volumes/fluence.npz"), "fluence")
    expected = ddrecon.fluence(ddrecon.load_scene("scene.yaml")).permute(1, 2, 3, 0)
    np.testing.assert_allclose(field.values, expected.numpy(), rtol=1e-4)
    assert field.values.shape == (4, 5, 6, 3)
    assert field.bounds is not None and field.bounds.tolist() == [[-0.5] * 3, [0.5] * 3]
    succeed(*RENDER, "--overwrite", "--fluence", "-D", "volume.sigma_s=5", "-D", "optimize=")
    assert read_field(Path("out/volumes/fluence.npz"), "fluence").values.shape == (4, 5, 6)


@pytest.mark.parametrize("said", [0, 1, 3])
def test_fluence_takes_two_rounds_at_least(succeed: Run, said: int) -> None:
    """But none where there are to be none."""
    rounds = f"diffusion.transport_rounds={said}"
    succeed(*RENDER, "--fluence", "-D", rounds)
    expected = ddrecon.load_scene("scene.yaml", overrides=[rounds.replace("1", "2")])
    field = read_field(Path("out/volumes/fluence.npz"), "fluence")
    fluence = ddrecon.fluence(expected).permute(1, 2, 3, 0).numpy()
    np.testing.assert_allclose(field.values, fluence, rtol=1e-4)


REST = [("1", "null", "what diffusion alone lacks"), ("16", "0.01", "at rest")]
REST += [("2", "0.1", "at rest"), ("2", "1e-6", "not at rest"), ("3", "null", "at rest")]


@pytest.mark.parametrize(("rounds", "tolerance", "verdict"), REST)
def test_it_is_said_whether_light_has_come_to_rest(
    succeed: Run, rounds: str, tolerance: str, verdict: str
) -> None:
    said = "-D", f"diffusion={{transport_rounds: {rounds}, transport_tolerance: {tolerance}}}"
    out = succeed(*RENDER, "--view", "side", *said).stdout
    report = json.loads(Path("out/render.json").read_text())["rounds"]
    changed = f"changed light by {100 * report['residual']:.2g} %: {verdict}"
    assert f"transport rounds: {report['count']}, the last {changed}" in out
    least = 0.01 if tolerance == "null" else float(tolerance)
    assert (report["residual"] < least) == (verdict == "at rest")


def test_a_balance_is_printed_and_a_record(succeed: Run) -> None:
    record = json.loads(succeed("balance", "scene.yaml", "--json").stdout)
    assert set(record["enters"]) == {"lights.0", "lights.1"}
    assert set(record["leaves"]) == {sign + axis for sign in "-+" for axis in "xyz"}
    entered = np.array([*record["enters"].values()]).sum(0)
    assert np.allclose(record["fractions"]["absorbed"], record["absorbed"] / entered)
    left = sum(np.array(part) for face in record["leaves"].values() for part in face.values())
    defect = 100 * (1 - (np.array(record["absorbed"]) + left) / entered)
    assert np.allclose(defect, record["defect_percent"])
    assert "neither absorbed nor left" in succeed("balance", "scene.yaml").stdout


def test_a_ring_is_a_movie_of_the_volume_from_around(
    succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    import imageio.v3 as iio

    monkeypatch.setattr("ddrecon.run.render_folder.FEW", 4)
    said = succeed(*RENDER, "--ring", "5", "--view", "front").stdout
    report = json.loads(Path("out/render.json").read_text())
    movie = iio.imread("out/ring.png", index=..., plugin="pillow")[..., :3]
    assert "movie: out/ring.png" in said and "ring_004: " in said
    assert "... 3 views between them, in render.json" in said and "ring_003: " not in said
    assert report["movie"]["file"] == "out/ring.png"
    assert report["psnr"] == {}
    assert list(report["files"]) == [f"ring_{index:03d}" for index in range(5)]
    white = report["movie"]["white"]
    for frame, name in zip(movie, report["files"], strict=True):
        assert np.abs(frame - encoded(pixels(name).astype(float) / white)).max() <= 1
    succeed("render", "scene.yaml", "-o", "front", "-q", "--view", "front")
    assert np.allclose(pixels("ring_000"), np.load("front/front.npy"), rtol=1e-4)


def test_another_light_is_as_if_the_scene_had_it(succeed: Run) -> None:
    lights = [
        "{type: ambient, radiance: 0.3}",
        "{type: point, position: [0, 2, 0], intensity: [1, 2, 3]}",
    ]
    said = succeed(
        *RENDER, *(argument for light in lights for argument in ("--light", light))
    ).stdout
    relit = pixels("front")
    succeed(*RENDER, "--overwrite", "-D", f"lights=[{', '.join(lights)}]")
    assert np.array_equal(pixels("front"), relit) and "PSNR" not in said


def test_cameras_of_a_file_at_a_size_without_their_pictures(succeed: Run) -> None:
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


def test_a_size_keeps_the_width_of_view(succeed: Run) -> None:
    """The mean of twice as many pixels is near the picture of few, and a taller one goes on."""
    succeed(*RENDER, "--view", "front", "--size", "80", "60")
    fine = pixels("front")
    succeed(*RENDER, "--overwrite", "--view", "front", "--size", "80", "100")
    taller = pixels("front")
    assert np.allclose(taller[20:80], fine, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("suffix", ["png", "mp4"])
def test_a_movie_has_the_exposure_of_its_previews(succeed: Run, suffix: str) -> None:
    import imageio.v3 as iio

    pytest.importorskip("imageio_ffmpeg")
    succeed(*RENDER, "--ring", "3", "--size", "33", "21", "--movie", f"m.{suffix}", "--fps", "12")
    if suffix == "mp4":
        times = frame_times(Path("m.mp4"))
        frames = [read_frame(Path("m.mp4"), number)[:21, :33] for number in range(3)]
        assert times == pytest.approx([0, 1 / 12, 2 / 12])
    else:
        frames = [*iio.imread("m.png", index=..., plugin="pillow")[..., :3]]
    previews = [iio.imread(f"out/ring_{number:03d}.png") for number in range(3)]
    for frame, preview in zip(frames, previews, strict=True):
        assert np.abs(frame.astype(float) - preview).mean() < (3 if suffix == "mp4" else 0.01)
    white = json.loads(Path("out/render.json").read_text())["movie"]["white"]
    for number, preview in enumerate(previews):
        assert np.abs(preview - encoded(pixels(f"ring_{number:03d}") / white)).max() <= 1


def test_a_movie_that_lacks_a_package_is_refused_before_rendering(
    refuse: Callable[..., list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert refuse(3, *RENDER, "--movie", "m.mp4") == [f"m.mp4: {advice('imageio_ffmpeg')}"]
