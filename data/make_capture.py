"""Makes data/capture: smoke as five cameras on tripods film it, with all that cameras do to it.

    python data/make_capture.py [--paths 256 | --respoil] [-o FOLDER]
    python data/make_capture.py --film [--paths 512] [-o FOLDER]

The smoke is that of `make_smoke.py`; Mitsuba 3 traces its pictures along ddrecon's own view rays,
`--paths` a pixel (with DRJIT_LIBLLVM_PATH it is some ten times faster). Then each picture is
spoiled: exposure, white balance, black level, shot noise, sRGB of 8 bits, a film in H.264, of which
one frame is taken; and each training camera is told a little wrong. What is true stands in
truth.json and density.npz. `--respoil` takes the smoke and its pictures from the folder, where they
are kept, and needs no Mitsuba. `--film` makes data/film instead: 24 frames that end with that
one, at half the pixels, by the same cameras; of each frame its density.

A film needs imageio-ffmpeg: pip install imageio-ffmpeg.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from make_smoke import simulate
from torch import Tensor

from ddrecon.cameras import Camera, cast_rays, look_at, subpixel_offsets, twist
from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.pictures import encode
from ddrecon.reference.trace import Tracer, open_tracer
from ddrecon.scene import Scene, View
from ddrecon.settings import RenderSettings

FOLDER = Path(__file__).parent
CELLS = (48, 72, 48)
BOX = ((-0.5, 0.0, -0.5), (0.5, 1.5, 0.5))
"""The volume [m], y up."""
STEPS, SEED = 108, 1
SIGMA_T, ALBEDO, G = 10.0, 0.92, 0.3
SUN, IRRADIANCE = (0.8, -0.45, -0.4), (7.3, 7.0, 6.4)
AMBIENT = (0.08, 0.1, 0.13)
SIZE = (240, 160)
ANGLES = {"cam_0": -55.0, "cam_1": -19.0, "cam_2": 18.0, "cam_3": 55.0, "held_out": 36.0}
"""Where each camera stands around the smoke [degrees from +z towards +x]."""
HEIGHTS, DISTANCES = (0.9, 0.5, 1.2, 0.7, 0.95), (2.6, 2.75, 2.5, 2.65, 2.6)
FOCAL = 368.0
"""Focal length [pixels], but for a percent from camera to camera."""
LENS = (-0.25, 0.08, 0.0, 0.0, 0.001, -0.0015)
TURNED, MOVED = 0.3, 0.003
"""Errors of calibration: degrees, and meters per meter of distance."""
PHOTONS = 8000
"""Electrons of a pixel that is just white."""
SUBPIXELS = 16
FRAMES, TAKEN = 24, 17
"""Frames of a film, and the one that is taken: not a first one, which alone is coded by itself."""
QUALITY = 19
"""The constant rate factor of H.264; 18 is hardly told from what was filmed, 23 is usual."""
PACE = 2
"""Steps of the smoke from frame to frame of data/film."""


def true_cameras() -> dict[str, Camera]:
    """The five cameras as they stand, in float64."""
    generator = np.random.default_rng(SEED)
    cameras = {}
    for (name, angle), height, distance in zip(ANGLES.items(), HEIGHTS, DISTANCES, strict=True):
        turn = np.radians(angle)
        eye = (distance * np.sin(turn), height, distance * np.cos(turn))
        target = (generator.normal(0, 0.02), 0.74 + generator.normal(0, 0.02), 0.0)
        lean = np.radians(generator.normal(0, 1.0))
        up = (np.sin(lean) * np.cos(turn), np.cos(lean), -np.sin(lean) * np.sin(turn))
        pose = look_at(*(torch.tensor(vector, dtype=torch.float64) for vector in (eye, target, up)))
        focal = FOCAL * (1 + 0.01 * generator.normal())
        middle = tuple(0.5 + 0.01 * generator.normal(size=2))
        lens = torch.tensor(LENS, dtype=torch.float64) * (1 + 0.05 * generator.normal())
        half = SIZE[1] / 2 / focal
        cameras[name] = Camera(pose, SIZE, half, True, middle, 1.0, "opencv", lens)
    return cameras


def told_cameras(cameras: dict[str, Camera]) -> dict[str, Camera]:
    """The cameras as their calibration has them.

    What all training cameras err in together is no error but another choice of the world's axes,
    origin and unit: it is taken off. The held-out camera is told right, since it is the ruler.
    """
    generator = torch.Generator().manual_seed(SEED)
    center = torch.tensor([(low + high) / 2 for low, high in zip(*BOX, strict=True)]).double()
    names = [name for name in cameras if name != "held_out"]
    turns, shifts, arms = [], [], []
    for name in names:
        arm = cameras[name].pose[:, 3] - center
        turn = np.radians(TURNED) * _random_way(generator)
        shift = MOVED * arm.norm() * _random_way(generator)
        # A turn about the camera is one about the center, and a shift back.
        turns.append(turn)
        shifts.append(shift - torch.linalg.cross(turn, arm))
        arms.append(arm)
    turn, shift, arm = (torch.stack(vectors) for vectors in (turns, shifts, arms))
    turn = turn - turn.mean(0)
    common = torch.cat([torch.eye(3).double().repeat(len(names), 1), arm.view(-1, 1)], 1)
    shift = shift.view(-1, 1)
    shift = (shift - common @ torch.linalg.lstsq(common, shift).solution).view(-1, 3)
    told = dict(cameras)
    for index, name in enumerate(names):
        axes = cameras[name].pose[:, :3]
        change = torch.cat([axes.T @ turn[index], axes.T @ shift[index]])
        told[name] = twist(cameras[name], change, tuple(center.tolist()))
    return told


def _random_way(generator: torch.Generator) -> Tensor:
    """A vector of unit length."""
    vector = torch.randn(3, generator=generator, dtype=torch.float64)
    return vector / vector.norm()


def scene_of(density: Tensor, cameras: dict[str, Camera]) -> Scene:
    """The smoke of `density` in its light."""
    sigma = torch.tensor([SIGMA_T], dtype=torch.float64)
    grid = Grid.from_xyz(CELLS, *BOX)
    phase = HenyeyGreenstein(torch.tensor(G, dtype=torch.float64))
    volume = Volume(grid, density.double(), (1 - ALBEDO) * sigma, ALBEDO * sigma, phase)
    vectors = (torch.tensor(vector, dtype=torch.float64) for vector in (SUN, IRRADIANCE, AMBIENT))
    direction, irradiance, radiance = vectors
    lights = [DirectionalLight(direction, irradiance), AmbientLight(radiance)]
    views = [View(name, camera) for name, camera in cameras.items()]
    return Scene(volume, lights, views, RenderSettings(background=False))


def trace(tracer: Tracer, camera: Camera, paths: int, seed: int) -> np.ndarray:
    """The picture [h, w, 3] of `camera`, whose rays Mitsuba's cameras cannot cast."""
    mitsuba, (scene,) = tracer.module, tracer.scenes
    total = np.zeros((*camera.size, 3))
    count = max(1, paths // SUBPIXELS)
    for index, offset in enumerate(subpixel_offsets(SUBPIXELS)):
        rays = cast_rays(camera, offset)
        origin, direction = (
            mitsuba.Point3f(*np.repeat(vectors.flip(1).numpy().T.astype(np.float32), count, 1))
            for vectors in (rays.origin, rays.direction)
        )
        sampler = mitsuba.load_dict({"type": "independent"})
        sampler.seed(SUBPIXELS * seed + index, count * camera.size[0] * camera.size[1])
        ray = mitsuba.RayDifferential3f(mitsuba.Ray3f(origin, mitsuba.Vector3f(direction)))
        radiance, _, _ = scene.integrator().sample(scene, sampler, ray)
        total += np.array(radiance).T.reshape(*camera.size, count, 3).mean(2)
    return total / SUBPIXELS


def spoil(
    pictures: Sequence[np.ndarray], exposure: np.ndarray, black: float, seed: int
) -> np.ndarray:
    """The frames [n, h, w, 3] of 8 bits of a film of the radiance `pictures`, each with noise."""
    generator = np.random.default_rng(seed)
    frames = []
    for picture in pictures:
        noisy = generator.poisson(PHOTONS * (picture * exposure + black).clip(0)) / PHOTONS
        frames.append(np.round(255 * encode(noisy.clip(0, 1))).astype(np.uint8))
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        # By imageio-ffmpeg, as `quality` of its own would leave the rate open.
        imageio.imwrite(
            film,
            np.stack(frames),
            codec="libx264",
            pixelformat="yuv420p",
            quality=None,
            output_params=["-crf", str(QUALITY)],
            macro_block_size=1,
        )
        return imageio.imread(film)


def rising(picture: np.ndarray) -> list[np.ndarray]:
    """A film in which what `picture` shows rises by a pixel a frame; it is the frame `TAKEN`."""
    return [np.roll(picture, TAKEN - number, axis=0) for number in range(FRAMES)]


def exposures() -> dict[str, tuple[np.ndarray, float]]:
    """The gain by color and the black level of each camera.

    Gains have a geometric mean of 1 over the training cameras in each color: the light has the
    rest. The held-out camera is the ruler, and has neither.
    """
    generator = np.random.default_rng(SEED + 1)
    gains = generator.uniform(0.7, 1.3, (len(ANGLES), 1)) * generator.uniform(
        0.9, 1.1, (len(ANGLES), 3)
    )
    gains /= np.exp(np.log(gains[:4]).mean(0))
    blacks = generator.uniform(0.0005, 0.0025, len(ANGLES))
    gains[-1], blacks[-1] = 1, 0
    return {name: (gains[i], blacks[i]) for i, name in enumerate(ANGLES)}


def frame(camera: Camera, **others: object) -> dict[str, object]:
    """`camera` as a frame of a transforms.json."""
    height, width = camera.size
    focal = width / 2 / float(camera.half_width)
    x, y = camera.principal_point
    lens = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), camera.distortion.tolist(), strict=True))
    numbers = {"fl_x": focal, "fl_y": focal, "cx": x * width, "cy": y * height} | lens
    matrix = [*camera.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
    return others | {"w": width, "h": height} | numbers | {"transform_matrix": matrix}


def write_cameras(path: Path, frames: list[dict[str, object]], folder: str) -> None:
    """A transforms.json whose last frame is held out."""
    names = [frame["file_path"] for frame in frames]
    splits = {"train_filenames": names[:-1], "test_filenames": names[-1:]}
    path.write_text(json.dumps({"camera_model": "OPENCV", **splits, "frames": frames}, indent=1))


def write_density(path: Path, density: np.ndarray) -> None:
    """Writes the volume that pictures show."""
    np.savez_compressed(path, density=density.astype(np.float16), bounds=np.array(BOX))


def write_told(folder: Path, told: dict[str, Camera], suffix: str) -> None:
    """Writes the cameras as a calibration tells them; their pictures end in `suffix`."""
    wrong = [frame(told[name], file_path=f"{name}{suffix}") for name in told]
    write_cameras(folder / "transforms.json", wrong, "")


def smokes() -> list[np.ndarray]:
    """The density after each step."""
    return [np.round(smoke * 256) / 256 for smoke in simulate(CELLS[::-1], STEPS, SEED)]


def make_capture(folder: Path, paths: int, is_kept: bool) -> None:
    """Writes data/capture; the pictures that `is_kept` says are in the folder are not traced."""
    cameras = true_cameras()
    if is_kept:
        kept = {name: np.load(folder / "clean" / f"{name}.npy").astype(float) for name in cameras}
    else:
        density = smokes()[-1]
        tracer = open_tracer(scene_of(torch.from_numpy(density), cameras), [])
        kept = {
            name: trace(tracer, camera, paths, seed)
            for seed, (name, camera) in enumerate(cameras.items())
        }
        (folder / "clean").mkdir(parents=True, exist_ok=True)
        write_density(folder / "density.npz", density)
    truth = []
    for seed, (name, (exposure, black)) in enumerate(exposures().items()):
        film = spoil(rising(kept[name]), exposure, black, seed)
        imageio.imwrite(folder / f"{name}.png", film[TAKEN])
        np.save(folder / "clean" / f"{name}.npy", kept[name].astype(np.float16))
        known = {"exposure": exposure.tolist(), "black": black}
        truth.append(frame(cameras[name], file_path=f"clean/{name}.npy", **known))
    write_cameras(folder / "truth.json", truth, "clean")
    write_told(folder, told_cameras(cameras), ".png")


def make_film(folder: Path, paths: int) -> None:
    """Writes data/film."""
    cameras = {name: camera.resize(2) for name, camera in true_cameras().items()}
    folder.mkdir(parents=True, exist_ok=True)
    clean: dict[str, list[np.ndarray]] = {name: [] for name in cameras}
    for number, density in enumerate(smokes()[-1 - PACE * (FRAMES - 1) :: PACE]):
        write_density(folder / f"density_{number:04d}.npz", density)
        tracer = open_tracer(scene_of(torch.from_numpy(density), cameras), [])
        for seed, (name, camera) in enumerate(cameras.items(), len(cameras) * number):
            clean[name].append(trace(tracer, camera, paths, seed))
    truth = []
    for seed, (name, (exposure, black)) in enumerate(exposures().items()):
        for number, picture in enumerate(spoil(clean[name], exposure, black, seed)):
            imageio.imwrite(folder / f"{name}_{number:04d}.png", picture)
        known = {"exposure": exposure.tolist(), "black": black}
        truth.append(frame(cameras[name], file_path=f"{name}_{{frame:04d}}.png", **known))
    write_cameras(folder / "truth.json", truth, "")
    told = {name: camera.resize(2) for name, camera in told_cameras(true_cameras()).items()}
    write_told(folder, told, "_{frame:04d}.png")


def main() -> None:
    """Writes all of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--paths", type=int)
    parser.add_argument("--respoil", action="store_true")
    parser.add_argument("--film", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    if given.film:
        make_film(given.output or FOLDER / "film", given.paths or 512)
    else:
        make_capture(given.output or FOLDER / "capture", given.paths or 256, given.respoil)


if __name__ == "__main__":
    main()
