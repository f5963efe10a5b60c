"""Camera files of other programs: read, written, refused by key."""

import itertools
import json
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from example_scene import SCENE, changed

from ddrecon.cameras import cast_rays, distort, project
from ddrecon.errors import FormatError, SceneError
from ddrecon.scene_file.build import build_scene, load_scene
from ddrecon.scene_file.build_views import remove_pictures
from ddrecon.scene_file.camera_files import MODELS, UNMODELED, export_transforms
from ddrecon.scene_file.load import describe, dump_scene, read_scene
from ddrecon.scene_file.view_schema import (
    FisheyeSection,
    OpencvSection,
)
from ddrecon.settings import LENSES

POSE = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.8, 0.6, 1.8], [0.0, -0.6, 0.8, 2.4], [0.0, 0.0, 0.0, 1.0]]
MATRIX = tuple(map(tuple, POSE))
"""Looks at the origin, nearly: from behind it along z and from above along y."""
SIZES = {"w": 8, "h": 6, "fl_x": 20.0, "fl_y": 19.0, "cx": 4.3, "cy": 2.9}
IGNORED = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], "aabb_scale": 16}
NERFSTUDIO = SIZES | IGNORED | {"camera_model": "OPENCV", "k1": 0, "k2": 0.0, "ply_file_path": "a"}


def frame(name="images/frame_00001.npy", **others):
    path = {"file_path": name} if name else {}
    return path | {"transform_matrix": POSE, "sharpness": 37.5} | others


def transforms(path, *frames, **shared):
    """A scene whose views are in a file at `path`, which is written."""
    path.write_text(json.dumps(shared | {"frames": frames}))
    return changed(views={"transforms": path.name})


@pytest.fixture
def views(read, tmp_path):
    """The views of `frames` in a file that says what is `shared`."""
    path = tmp_path / "transforms.json"
    return lambda *frames, **shared: read(transforms(path, *frames, **shared)).tree.views


def test_rays_are_those_of_the_calibration(read, tmp_path):
    """Pixel centers, +y up and looking along -z; other programs' boxes change nothing."""
    read(transforms(tmp_path / "transforms.json", frame(None), **NERFSTUDIO))
    (view,) = load_scene(tmp_path / "scene.yaml", dtype=torch.float64).views
    bundle, pose = cast_rays(view.camera), torch.tensor(POSE, dtype=torch.float64)
    assert view.camera.size == (6, 8) and torch.equal(bundle.eye.flip(0), pose[:3, 3])
    for index, (row, column) in enumerate(itertools.product(range(6), range(8))):
        way = pose.new_tensor([(column + 0.5 - 4.3) / 20, -(row + 0.5 - 2.9) / 19, -1])
        toward = pose[:3, :3] @ way / way.norm()
        torch.testing.assert_close(bundle.direction[index].flip(0), toward, rtol=0, atol=1e-14)


def test_nerf_synthetic_data(read, tmp_path):
    """An angle alone, images without a suffix, whose size is theirs, and a file for each split."""
    for split in ("train", "val"):
        path = tmp_path / f"transforms_{split}.json"
        transforms(path, frame(f"./{split}/r_0"), camera_angle_x=0.6)
    files = ["transforms_train.json", "transforms_val.json"]
    train, val = read(changed(views={"transforms": files})).tree.views
    assert train.image == tmp_path / "train/r_0.png" and val.image == tmp_path / "val/r_0.png"
    assert (train.split, val.split) == ("train", "test")
    assert (train.name, val.name) == ("train_r_0", "val_r_0")
    assert train.camera.fov == pytest.approx(math.degrees(0.6)) and not train.camera.resolution


def angle(focal, pixels):
    return 2 * math.atan(pixels / 2 / focal)


def focal(x, y, width=8):
    """What a camera has of focal lengths in pixels."""
    return {"fov": math.degrees(angle(x, width)), "pixel_aspect": x / y}


SAID = {"fl_x": 20, "fl_y": 19}
BENT = {"distortion": OpencvSection(k1=0.05)}


@pytest.mark.parametrize(
    ("shared", "of_frame", "expected"),
    [
        (SAID, {}, focal(20, 19)),
        ({"camera_angle_x": angle(20, 8), "camera_angle_y": angle(19, 6)}, {}, focal(20, 19)),
        ({"x_fov": math.degrees(angle(20, 8)), "fl_y": 19}, {}, focal(20, 19)),
        ({"fl_x": 20}, {}, focal(20, 20)),
        ({"y_fov": math.degrees(angle(19, 6))}, {}, focal(19, 19)),
        # a frame's own, whatever it is said by, and then nothing of the file's
        (SAID, {"camera_angle_x": angle(40, 8)}, focal(40, 40)),
        ({"x_fov": 30, "y_fov": 40}, {"fl_x": 40, "fl_y": 38}, focal(40, 38)),
        ({"camera_angle_x": angle(20, 16)}, {"w": 16, "h": 8}, focal(20, 20, 16)),
        (SAID | {"k1": -0.1, "k2": 0.02}, {"k1": 0.05}, BENT),
        (SAID | {"k1": 0.05}, {"camera_model": "PINHOLE"}, {"distortion": None}),
        (SAID | {"k1": 0.05}, {"is_fisheye": True}, {"distortion": FisheyeSection(k1=0.05)}),
        (SAID | {"k1": 0.05, "is_fisheye": True}, {"camera_model": "OPENCV"}, BENT),
        (SAID | {"ftheta_p1": 0.01, "latlong": True}, {"k1": 0.05}, BENT),
        (SAID | {"k1": 0.05, "latlong": False, "sk_x": 0.0, "dist": [0, 0]}, {}, BENT),
        (NERFSTUDIO, {"w": 16.0, "h": 12, "cx": 8, "cy": 6}, {"resolution": (16, 12)}),
        (NERFSTUDIO, {"w": 16.0, "cx": 8, "cy": 6}, {"principal_point": (0.5, 1)}),
        (NERFSTUDIO, {"cx": 2, "h": 12}, {"principal_point": (2 / 8, 2.9 / 12)}),
        (NERFSTUDIO, {"cx": 2, "h": 12}, {"resolution": (8, 12), "matrix": MATRIX}),
    ],
)
def test_what_a_frame_says_is_before_what_its_file_says(views, shared, of_frame, expected):
    (view,) = views(frame(**of_frame), **({"w": 8, "h": 6} | shared))
    for name, value in expected.items():
        is_number = isinstance(value, float)
        assert getattr(view.camera, name) == (
            pytest.approx(value, rel=1e-14) if is_number else value
        )
    assert "cx" in shared or view.camera.principal_point == (0.5, 0.5)


def test_a_frame_may_have_a_mask(views, tmp_path):
    first, second = views(frame("a.png"), frame("b.png", mask_path="masks/b.png"), **NERFSTUDIO)
    assert first.mask is None and second.mask == tmp_path / "masks/b.png"


@pytest.mark.parametrize(
    ("name", "existing", "image"),
    [
        ("images\\r_0.png", ["images/r_0.png"], "images/r_0.png"),
        (".\\images\\r_0", [], "images/r_0.png"),
        ("a\\b.png", ["a\\b.png"], "a\\b.png"),
        ("images/r_0.12", [], "images/r_0.12.png"),
        ("images/r_0.left", ["images/r_0.left.png"], "images/r_0.left.png"),
        ("IMG_1.HEIC", ["IMG_1.HEIC"], "IMG_1.HEIC"),
        ("IMG_1.DNG", [], "IMG_1.DNG"),
        ("r_0", ["r_0"], "r_0"),
    ],
)
def test_which_picture_a_name_means(views, tmp_path, name, existing, image):
    (tmp_path / "images").mkdir()
    for file in existing:
        (tmp_path / file).touch()
    (view,) = views(frame(name), **NERFSTUDIO)
    assert view.image == tmp_path / image


def test_a_file_of_windows_is_read(read, tmp_path):
    """With a byte order mark, as its editors write text."""
    before = read(transforms(tmp_path / "a.json", frame(), **NERFSTUDIO))
    for path in (tmp_path / "a.json", tmp_path / "scene.yaml"):
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-8-sig"))
    assert read_scene(tmp_path / "scene.yaml").tree == before.tree


@pytest.mark.parametrize(
    ("name", "more", "test_every", "expected"),
    [
        ("transforms.json", {}, None, "....."),
        ("transforms.json", {}, 2, "t.t.t"),
        ("transforms_test.json", {}, 2, "ttttt"),
        ("transforms_train.json", {}, 2, "....."),
        ("contest.json", {}, None, "....."),
        (
            "transforms.json",
            {"train": ["0.png"], "val": ["3.png"], "test": ["./4.png"]},
            2,
            "...tt",
        ),
        ("transforms.json", {"val": []}, None, "....."),
    ],
)
def test_which_views_are_held_out(read, tmp_path, name, more, test_every, expected):
    """Which of five are training views (.), and which test views (t)."""
    lists = {f"{split}_filenames": names for split, names in more.items()}
    transforms(tmp_path / name, *(frame(f"{i}.png") for i in range(5)), **NERFSTUDIO, **lists)
    source = {"transforms": name} | ({"test_every": test_every} if test_every else {})
    splits = [view.split for view in read(changed(views=source)).tree.views]
    assert "".join("t" if split == "test" else "." for split in splits) == expected


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/0.png", "b/1.png"], ["0", "1"]),
        (["a/0.png", "b c/0.png"], ["a_0", "b_c_0"]),
        (["x/a/0.png", "y/a/0.png"], ["000_0", "001_0"]),
        (["a.single.png", None], ["a_single", "view_01"]),
        ([f"{'n' * 240}{index}.png" for index in (0, 1)], ["n" * 98 + "0", "n" * 98 + "1"]),
    ],
)
def test_names_are_legal_and_differ(views, files, names):
    assert [view.name for view in views(*map(frame, files), **NERFSTUDIO)] == names


WRONG = """
{"k5": 0.01} => k5: k5 = 0.01 is not modeled; undistort
{"camera_model": "OPENCV_FISHEYE", "p1": 1e-3} => p1: p1 = 0.001 is not modeled
{"camera_model": "EQUIRECTANGULAR"} => camera_model: EQUIRECTANGULAR is a lens
{"ftheta_p0": 0.0, "ftheta_p1": 0.01} => ftheta_p1: is of a lens that is not
{"frame": {"latlong": true}} => frames.0.latlong: is of a lens that is not modeled; undistort
{"frame": {"K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}} => frames.0.K: is not read: write fl_x, fl_y
{"frame": {"dist_coeffs": [[0.1, 0]]}} => frames.0.dist_coeffs: is not read: write k1, k2
{"is_fisheye": "false"} => is_fisheye: expected true or false
{"x_fov": 180} => x_fov: must be below 180
{"fl_x": 0} => fl_x: must be above 0
{"w": 8.5} => w: expected a whole number, found 8.5
{"w": HUGE} => w: expected a finite number
{"cx": NaN} => cx: expected a finite number
{"frames": []} => frames: expected a list with at least one frame
{"frame": {"transform_matrix": [[1, 0, 0, 0]]}} => frames.0.transform_matrix: expected a list of 4 r
{"frame": {"transform_matrix": SCALED}} => frames.0.transform_matrix: must be rigid
{"frames": [{"file_path": "a.png"}]} => frames.0: missing key 'transform_matrix'
{"frames": [3]} => frames.0: expected a mapping, found 3
{"frame": {"name": 7}} => frames.0.file_path: expected a file, found 7
{"val_filenames": [3]} => val_filenames.0: expected a file, found 3
{"only": {"w": 8, "h": 6}} => frames.0: has neither fl_x nor camera_angle_x
{"only": {"fl_x": 20}} => fl_x: is in pixels, but w and h do not say how many there are
{"only": {"camera_angle_y": 0.5}} => frames.0: says how high its picture is, but not how wide
{"only": {"camera_angle_x": 0.5}, "frame": {"name": null}} => frames.0: has neither file_path nor w
"""
"""What a file says besides `NERFSTUDIO`, or `only` that, what its `frame`; and its one line."""
NUMBERS = {
    "HUGE": f"1{'0' * 400}",
    "SCALED": str([[2 * x for x in row] for row in POSE[:3]] + POSE[3:]),
}


@pytest.mark.parametrize("row", WRONG.strip().split("\n"))
def test_what_is_no_camera_of_ours_is_refused_by_key(refusal, tmp_path, row):
    text, _, problem = row.partition(" => ")
    for word, number in NUMBERS.items():
        text = text.replace(word, number)
    said = json.loads(text)
    frames = said.pop("frames", [frame(**said.pop("frame", {}))])
    shared = said.pop("only", NERFSTUDIO) | said
    (line,) = refusal(transforms(tmp_path / "t.json", *frames, **shared), kind=FormatError)
    assert line.startswith(f"t.json: {problem}")


def test_a_film_begins_at_its_time(read, views, tmp_path):
    """What others call a time, of pictures, is none; it comes back when views are exported."""
    timed = views(frame("a.mp4", time=0.5), frame("b.png", time=0.5), **NERFSTUDIO)
    assert [view.time for view in timed] == [0.5, 0.0]
    empty = read(transforms(tmp_path / "t.json", frame(None), frame(None), **NERFSTUDIO))
    whole = replace(empty, tree=replace(empty.tree, views=timed))
    export_transforms(build_scene(empty), whole, tmp_path / "again.json", may_exist=False)
    first = json.loads((tmp_path / "again.json").read_text())["frames"][0]
    assert (first["time"], first["file_path"]) == (0.5, "a.mp4")


def test_what_is_exported_comes_back(read, tmp_path):
    """Cameras, images, masks and splits, also from a folder of its own."""
    (tmp_path / "images").mkdir()
    (tmp_path / "out").mkdir()
    for name in ("a", "b"):
        np.save(tmp_path / f"images/{name}.npy", np.ones((6, 8, 3), np.float32))
    camera = {"type": "perspective", "matrix": POSE, "fov": 30, "pixel_aspect": 1.05}
    camera |= {"principal_point": [0.4, 0.55], "resolution": [8, 6]}
    front = {"name": "a", "image": "images/a.npy", "mask": "images/b.npy", "camera": camera}
    side = {"name": "b", "image": "images/b.npy", "split": "test", "camera": camera | {"fov": 40}}
    side |= {"frame": 3}
    scene_file = read(json.dumps(yaml.safe_load(SCENE) | {"views": [front, side]}))
    before, path = build_scene(scene_file, dtype=torch.float64), tmp_path / "out/transforms.json"
    assert export_transforms(before, scene_file, path, may_exist=False) == [path]
    again = read(changed(views={"transforms": "out/transforms.json"}))
    for old, new in zip(scene_file.tree.views, again.tree.views, strict=True):
        assert new.image is not None and (old.name, old.split) == (new.name, new.split)
        assert (old.frame, old.time) == (new.frame, new.time)
        assert new.image.resolve() == old.image
        assert (new.mask and new.mask.resolve()) == old.mask
    for old, new in zip(before.views, build_scene(again, dtype=torch.float64).views, strict=True):
        rays = cast_rays(old.camera).direction, cast_rays(new.camera).direction
        torch.testing.assert_close(*rays, rtol=0, atol=1e-14)
        assert torch.equal(old.camera.pose, new.camera.pose) and old.camera.size == new.camera.size
    flat = read(SCENE.replace("perspective", "orthographic").replace("fov: 28", "width: 2"))
    with pytest.raises(SceneError, match="orthographic camera has no place"):
        export_transforms(build_scene(flat), flat, path, may_exist=True)


DISTORTED = {
    "OPENCV": {"k1": -0.1, "k2": 0.02, "k3": 0.0, "k4": 0.0, "p1": 1e-3, "p2": -2e-3},
    "OPENCV_FISHEYE": {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": 0.0},
}


@pytest.mark.parametrize("model", DISTORTED)
def test_lenses_are_read_and_written(read, tmp_path, model):
    """Through our own scene files and transforms, to the same rays."""
    numbers = SIZES | IGNORED | {"camera_model": model, **DISTORTED[model]}
    scene_file = read(transforms(tmp_path / "transforms.json", frame(None), **numbers))
    dump_scene(describe(scene_file), tmp_path / "dump.yaml")
    assert read_scene(tmp_path / "dump.yaml").tree == scene_file.tree
    scene = build_scene(scene_file, dtype=torch.float64)
    export_transforms(scene, scene_file, tmp_path / "again.json", may_exist=True)
    again = build_scene(read(changed(views={"transforms": "again.json"})), dtype=torch.float64)
    rays = [cast_rays(built.views[0].camera).direction for built in (scene, again)]
    torch.testing.assert_close(*rays, rtol=0, atol=1e-15)


LEFT = {"w": 40, "h": 1000, "fl_x": 20.0, "fl_y": 2e3, "cx": 0.0, "cy": 500.0, "k1": -0.3}
"""Its axis is at the left edge, where it does not fold over."""


@pytest.mark.parametrize("numbers", [NERFSTUDIO | {"k1": -12.0}, LEFT])
def test_a_lens_that_folds_over_is_refused(read, tmp_path, numbers):
    scene_file = read(transforms(tmp_path / "transforms.json", frame(None), **numbers))
    with pytest.raises(SceneError, match="folds over within the image") as caught:
        build_scene(scene_file)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize("text", ["{}", "[]", "3"])
def test_a_file_without_frames_is_refused(refusal, tmp_path, text):
    (tmp_path / "t.json").write_text(text)
    (line,) = refusal(changed(views={"transforms": "t.json"}), kind=FormatError)
    assert line.startswith("t.json: has no 'frames'")


# COLMAP: rays as its manual has them, text and binary alike, and refusals in one line.

CAMERAS: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [20.0, 4.2, 3.1],
    "PINHOLE": [20.0, 19.0, 4.2, 3.1],
    "SIMPLE_RADIAL": [20.0, 4.2, 3.1, -0.2],
    "RADIAL": [20.0, 4.2, 3.1, -0.2, 0.1],
    "OPENCV": [20.0, 19.0, 4.2, 3.1, -0.2, 0.1, 0.01, -0.02],
    "OPENCV_FISHEYE": [20.0, 19.0, 4.2, 3.1, 0.05, -0.02, 0.01, 0.0],
}
QUATERNION = np.array([0.2, 0.9, -0.3, 0.1])
SHIFT = np.array([0.1, -0.2, 3.0])
"""Of a camera that looks at the world's origin from 3 u away, nearly."""


def rotation(quaternion):
    """By the sandwich q v q*, vector by vector."""
    w, *axis = quaternion / np.linalg.norm(quaternion)
    u = np.array(axis)
    columns = [2 * (u @ v) * u + (w * w - u @ u) * v + 2 * w * np.cross(u, v) for v in np.eye(3)]
    return np.stack(columns, 1)


def write_text(folder, model, name="b c.png"):
    folder.mkdir(parents=True, exist_ok=True)
    numbers = " ".join(map(str, CAMERAS[model]))
    (folder / "cameras.txt").write_text(f"# cameras\n7 {model} 8 6 {numbers}\n")
    pose = " ".join(map(str, [*QUATERNION, *SHIFT]))
    points = "1.5 2.5 -1 3.5 4.5 12"
    (folder / "images.txt").write_text(
        f"# images\n3 {pose} 7 {name}\n{points}\n4 {pose} 7 a.png\n\n"
    )


def write_binary(folder, model, name="b c.png", points=(2, 0)):
    folder.mkdir(parents=True, exist_ok=True)
    numbers = CAMERAS[model]
    header = struct.pack("<QiiQQ", 1, 7, list(MODELS).index(model), 8, 6)
    (folder / "cameras.bin").write_bytes(header + struct.pack(f"<{len(numbers)}d", *numbers))
    content = struct.pack("<Q", 2)
    for index, label, count in ((3, name, points[0]), (4, "a.png", points[1])):
        content += struct.pack("<i7di", index, *QUATERNION, *SHIFT, 7) + label.encode() + b"\0"
        content += struct.pack("<Q", count) + bytes(24 * count)
    (folder / "images.bin").write_bytes(content)


def scene_text(**others):
    return changed(views={"colmap": "sparse/0", "images": "pictures", **others})


@pytest.mark.parametrize("store", [write_text, write_binary])
@pytest.mark.parametrize("model", CAMERAS)
def test_points_are_seen_where_the_manual_says(read, tmp_path, model, store):
    """x = R X + t, divided by its depth, distorted, and times the focal lengths plus the center."""
    store(tmp_path / "sparse/0", model)
    scene_file = read(scene_text())
    first, second = scene_file.tree.views
    assert (first.name, second.name) == ("a", "b_c")
    assert second.image == tmp_path / "pictures" / "b c.png"
    scene = build_scene(remove_pictures(scene_file, None), dtype=torch.float64)
    camera = scene.views[1].camera
    parameters = dict(zip(MODELS[model].split(), CAMERAS[model], strict=True))
    lens = "fisheye" if model == "OPENCV_FISHEYE" else "opencv"
    numbers = torch.tensor([parameters.get(name, 0.0) for name in LENSES[lens]]).double()
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.4, 0.4, (10, 3)))
    rays = points @ torch.from_numpy(rotation(QUATERNION).T) + torch.from_numpy(SHIFT)
    focal = [parameters.get(name, parameters.get("f")) for name in ("fl_x", "fl_y")]
    expected = distort(lens, numbers, rays) * torch.tensor(focal) + torch.tensor([4.2, 3.1])
    seen, _ = project(camera, points)
    is_seen = ~seen.isnan().any(1)
    assert is_seen.any()
    torch.testing.assert_close(seen[is_seen], expected[is_seen], atol=1e-5, rtol=0)
    center = -rotation(QUATERNION).T @ SHIFT
    torch.testing.assert_close(cast_rays(camera).eye.flip(0), torch.tensor(center))


IMAGE = "1 0.2 0.9 -0.3 0.1 0.1 -0.2 3.0 7"
POINTS = "1.5 2.5 -1 3.5 4.5 12"


@pytest.mark.parametrize(
    "lines",
    [
        ["a.png", "b b 2.png", "b b 10.png"],
        ["b b 10.png", "", "a.png", "b b 2.png"],
        ["b b 2.png", POINTS, "b b 10.png", "a.png"],
        ["", "", "a.png", "", "  ", "# c", "b b 10.png", POINTS, "", "b b 2.png"],
    ],
)
def test_lines_of_points_may_be_missing(read, tmp_path, lines):
    """No image is taken for points, of as many words as these; pictures are in order of numbers."""
    write_text(tmp_path / "sparse/0", "PINHOLE")
    text = [f"{IMAGE} {line}" if line.endswith("png") else line for line in lines]
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(text))
    found = [(view.name, view.split) for view in read(scene_text(test_every=2)).tree.views]
    assert found == [("a", "test"), ("b_b_2", "train"), ("b_b_10", "test")]


def test_models_of_windows_are_read(read, tmp_path):
    """With a byte order mark, other ends of lines, and backslashes; but not out of the folder."""
    folder = tmp_path / "sparse/0"
    write_text(folder, "PINHOLE", "left\\c.png")
    for path in folder.iterdir():
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-8-sig"))
    views = read(changed(views={"colmap": "sparse\\0", "images": "pictures"})).tree.views
    assert [view.image for view in views] == [
        tmp_path / "pictures" / name for name in ("a.png", "left/c.png")
    ]
    write_text(folder, "PINHOLE", "left\\..\\..\\c.png")
    with pytest.raises(FormatError, match="leaves the folder of pictures"):
        read(scene_text())


@pytest.mark.parametrize("model", UNMODELED)
def test_cameras_that_no_image_has_may_be_of_any_model(read, tmp_path, model):
    """As text, and in a binary file, which says nothing of their length."""
    text, binary, count = tmp_path / "sparse/0", tmp_path / "sparse/1", UNMODELED[model]
    write_text(text, "PINHOLE")
    write_binary(binary, "PINHOLE")
    before = read(scene_text()).tree
    with (text / "cameras.txt").open("a") as stream:
        stream.write(f"8 {model} 8 6 {'0.5 ' * count}\n")
    cameras, kind = (binary / "cameras.bin").read_bytes()[8:], [*MODELS, *UNMODELED].index(model)
    strange = struct.pack(f"<QiiQQ{count}d", 2, 8, kind, 8, 6, *[0.5] * count)
    (binary / "cameras.bin").write_bytes(strange + cameras)
    assert read(scene_text()).tree == read(scene_text(colmap="sparse/1")).tree == before


@pytest.mark.parametrize(
    ("file", "old", "new", "problem"),
    [
        ("cameras.txt", "PINHOLE", "FOV", "camera 7: lens model FOV is not known; undistort"),
        ("cameras.txt", " 3.1", "", "camera 7: PINHOLE has 4 parameters, fl_x, fl_y, cx, cy"),
        ("cameras.txt", "8 6", "8 x", "line 2: expected CAMERA_ID MODEL WIDTH"),
        ("cameras.txt", "8 6", "8 0", "camera 7.h: must be at least 1, found 0"),
        ("cameras.txt", "20.0", "-20", "camera 7.fl_x: must be above 0"),
        ("cameras.txt", "20.0", "nan", "camera 7.fl_x: expected a finite number"),
        ("images.txt", " 7 b", " 8 b", "image 'b c.png': there is no camera 8"),
        ("images.txt", "b c.png", "/etc/c.png", "image '/etc/c.png' leaves the folder of pictures"),
        ("images.txt", "b c.png", "d/../../c.png", "leaves the folder of pictures"),
        ("images.txt", "3 0.2", "3 x", "line 2: expected IMAGE_ID QW QX"),
        ("images.txt", " 7 a.png", "", "line 4: expected IMAGE_ID QW QX"),
        ("images.txt", "0.2 0.9 -0.3 0.1 0.1", "0 0 0 0 0.1", "not finite, or no rotation"),
    ],
)
def test_a_damaged_text_is_refused(read, tmp_path, file, old, new, problem):
    write_text(tmp_path / "sparse/0", "PINHOLE")
    path = tmp_path / "sparse/0" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises((FormatError, SceneError)) as caught:
        read(scene_text())
    assert problem in str(caught.value) and "\n" not in str(caught.value)


def test_a_model_without_images_is_refused(read, tmp_path):
    write_text(tmp_path / "sparse/0", "PINHOLE")
    (tmp_path / "sparse/0/images.txt").write_text("# images\n")
    with pytest.raises(FormatError, match="has no images"):
        read(scene_text())


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_a_damaged_binary_is_refused(read, tmp_path, file):
    """Cut anywhere, in points that are skipped as well, or claiming more than there is."""
    write_binary(tmp_path / "sparse/0", "OPENCV", points=(0, 2))
    path = tmp_path / "sparse/0" / file
    whole = path.read_bytes()
    for damaged in (whole[:5], whole[:30], whole[:-5], b"\xff" * 8 + whole[8:], b""):
        path.write_bytes(damaged)
        with pytest.raises((FormatError, SceneError)) as caught:
            read(scene_text())
        assert "\n" not in str(caught.value)
