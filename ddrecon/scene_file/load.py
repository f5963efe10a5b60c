"""Scene files as records, and back: strict YAML; everything that is wrong is reported at once."""

import glob
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import yaml

from ddrecon.errors import FormatError, Problems, SceneError, UsageError, suggestion
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.reading import require_stored
from ddrecon.records import Violation
from ddrecon.scene_file.camera_files import in_order, node_of, read_colmap, read_transforms
from ddrecon.scene_file.read import (
    MAX_DEPTH,
    Node,
    Rule,
    describe_found,
    parse,
    path_in,
    read_record,
    resolve,
)
from ddrecon.scene_file.schema import SceneTree
from ddrecon.scene_file.view_schema import (
    FRAME,
    PerspectiveSection,
    RingSection,
    ViewSection,
    ViewSource,
    split_views,
)
from ddrecon.settings import AUTO, ParameterSettings
from ddrecon.variables.kinds import (
    CROSS_SECTIONS,
    EXTINCTION_AND_ALBEDO,
    KINDS,
    kind_of,
    pattern_of,
    split_name,
)

T = TypeVar("T")
PARAMETERS = "optimize.parameters"
"""Where keys are the names of variables, dots and all."""
DECIMAL = r"(?:(?<=_)-)?[0-9]+(?:\.[0-9]+)?"
"""A number in a name, if it may have a sign and a fraction."""
MAX_BYTES = 2**20
"""A scene file is no larger; thousands of views fit."""


@dataclass(frozen=True)
class SceneFile:
    """A scene file that was read.

    `tree` is its content, `path` where it lies, and `marks` are the `file:line:column` of each
    value by key path.
    """

    tree: SceneTree
    path: Path
    marks: Mapping[str, str]

    def refused(self, key: str, fault: str) -> SceneError:
        """The error that says what is wrong with the value at `key`.

        It points to the nearest value above it where it was not written itself.
        """
        nearest = key
        while nearest and nearest not in self.marks:
            nearest = nearest.rpartition(".")[0]
        return SceneError(f"{self.marks[nearest]}: {key}: {fault}")


def read_scene(
    path: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    options: Mapping[str, str] = MappingProxyType({}),
) -> SceneFile:
    """The scene file at `path` with `overrides` (`key.path=value`) put in, its box in numbers.

    Their paths start at the current folder. `options` are what a user typed in place of some of
    them, which else was `-D` and the override. Raises SceneError with one line per problem,
    UsageError for arguments that are none.
    """
    if not isinstance(path, str | os.PathLike):
        raise UsageError(f"path: expected that of a scene file, found {type(path).__name__}")
    is_list = isinstance(overrides, Iterable) and not isinstance(overrides, str)
    changes: list[Any] = [*overrides] if is_list else [None]
    if not all(isinstance(text, str) for text in changes):
        raise UsageError(f'overrides: expected a list, ["key.path=value"], found {overrides!r}')
    path, problems = Path(path), Problems()
    scene_file = None
    with problems.collecting():
        root = parse(_text(path), lambda line, column: f"{path}:{line}:{column}", problems)
        if root.value is None:
            raise root.refused("is empty")
        for text in changes:
            with problems.collecting():
                override(root, text, problems, options.get(text, f"-D {text}"))
        scene_file = _scene_of(root, path)
    problems.raise_any()
    assert scene_file is not None
    if AUTO in (scene_file.tree.volume.bounds, scene_file.tree.volume.resolution):
        from ddrecon.scene_file.build_views import fit_volume  # here, as it loads torch

        return fit_volume(scene_file)
    return scene_file


def read_described(described: Mapping[str, Any], path: Path) -> SceneFile:
    """The scene that `described` says in plain values, as `describe` returns them.

    It counts as read from the file at `path`. Raises SceneError as `read_scene` does.
    """
    return _scene_of(node_of("", str(path), described), path)


def _scene_of(root: Node, path: Path) -> SceneFile:
    finish: Any = {PARAMETERS: require_parameters, "views": partial(views_of, up=_up_of(root))}
    tree = read_record(root, SceneTree, Rule(SceneTree, path.absolute().parent, {}, finish))
    return SceneFile(tree, path, {node.key: node.where for node in root.walk()})


def _up_of(root: Node) -> str:
    """`volume.up` of a scene that is not read yet."""
    volume = root.entries().get("volume")
    entry = volume.value.get("up") if volume and isinstance(volume.value, dict) else None
    return str(entry.value) if entry and entry.value in ("x", "z") else "y"


def _text(path: Path) -> str:
    try:
        require_stored(path)
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FormatError as error:
        raise SceneError(str(error)) from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error
    end, fault = MAX_BYTES, f"is larger than {MAX_BYTES // 2**20} MiB; it is not a scene file"
    if len(data) <= MAX_BYTES:
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            end, fault = error.start, "is not UTF-8 text"
    line, column = data.count(b"\n", 0, end) + 1, end - data.rfind(b"\n", 0, end)
    raise SceneError(f"{path}:{line}:{column}: {fault}")


def override(root: Node, text: str, problems: Problems, where: str) -> None:
    """Puts the value of `text` (`key.path=value`, in YAML), typed as `where`, under `root`.

    Mappings are made as needed; a list is entered by index. Where keys themselves have dots, as
    those of parameters do, the longest one present or legal is taken. Raises SceneError.
    """
    path, separator, value = text.partition("=")
    if not separator or not all(path.split(".")):
        raise SceneError(f"{where}: expected key.path=value")
    if path.count(".") > MAX_DEPTH:
        raise SceneError(f"{where}: nested more than {MAX_DEPTH} deep")
    parent = root
    while path:
        name, path = _step(parent, path, where)
        node = Node(parent.child_key(name), where, where, {} if path else None)
        if not path and value.strip():
            node = parse(value, lambda line, column: where, problems, node.key)
            node.folder = Path.cwd()
        entries: Any = parent.value
        place = int(name) if isinstance(entries, list) else name
        if not path:
            entries[place] = node
        elif isinstance(entries, dict):
            entries.setdefault(name, node)
        parent = entries[place]


def _step(parent: Node, path: str, where: str) -> tuple[str, str]:
    """The beginning of `path` that leads to a child of `parent`, and what is left of it."""
    names, fault = path.split("."), ""
    if isinstance(parent.value, dict):
        for count in range(len(names), 0, -1):
            name = ".".join(names[:count])
            if name in parent.value or (parent.key == PARAMETERS and pattern_of(name) in KINDS):
                return name, ".".join(names[count:])
    elif not isinstance(parent.value, list):
        fault = f"{parent.key or 'the scene'} is {describe_found(parent)}, not a mapping or list"
    elif not re.fullmatch("[0-9]{1,9}", names[0]) or int(names[0]) >= len(parent.value):
        fault = f"no such entry: {parent.key} is {describe_found(parent)}, counted from 0"
    if fault:
        raise SceneError(f"{where}: {parent.child_key(names[0])}: {fault}")
    return names[0], ".".join(names[1:])


def require_parameters(
    section: Node, parameters: dict[str, ParameterSettings], folder: Path
) -> dict[str, ParameterSettings]:
    """`parameters` of `section`, by names of variables, of one pair of cross sections at most.

    Raises SceneError with all that is wrong with them.
    """
    problems, entries = Problems(), section.entries()
    if not parameters:
        raise section.refused(f"names no parameter; known: {', '.join(KINDS)}")
    for name, settings in parameters.items():
        node = entries[name]
        for key, fault in _violations(name, settings, parameters):
            error = node.entries()[key].refused(fault) if key else node.key_refused(fault)
            problems.note(error)
    problems.raise_any()
    return parameters


def _violations(
    name: str, settings: ParameterSettings, parameters: Collection[str]
) -> Iterator[Violation]:
    """What is wrong with the parameter `name`, beside others, and at which of its keys."""
    if pattern_of(name) not in KINDS:
        yield "", f"unknown parameter{suggestion(pattern_of(name), KINDS)}"
        return
    kind, (medium, last) = kind_of(name), split_name(name)
    if settings.support is not None and name != "density":
        yield "support", f"{settings.support!r} is for density alone"
    for key in ("min", "max", "init"):
        value = getattr(settings, key)
        numbers = value if isinstance(value, tuple) else (value,)
        beyond = [x for x in numbers if isinstance(x, float) and not kind.low <= x <= kind.high]
        if beyond:
            yield key, f"must be {kind.limits}, found {beyond[0]:g}"
    if kind.is_direction and settings.init == (0, 0, 0):
        yield "init", "must not be zero"
    for key in ("field", "tv"):
        if getattr(settings, key) and not kind.is_cellwise:
            yield key, "it is not a field, so it has none"
    pair = [medium + sigma for sigma in CROSS_SECTIONS if medium + sigma in parameters]
    if last in EXTINCTION_AND_ALBEDO and pair:
        pairs = "take sigma_a and sigma_s, or sigma_t and albedo"
        yield "", f"cannot be optimized beside {pair[0]}: {pairs}"


def views_of(
    node: Node, source: ViewSource | tuple[ViewSection, ...], folder: Path, up: str
) -> tuple[ViewSection, ...]:
    """The named views that `source` lists or stands for, which `node` of a scene in `folder` says.

    The axis `up` points up in the scene.
    """
    if isinstance(source, tuple):
        return name_listed(node, source)
    entries, every = node.entries(), source.test_every
    if "images" in entries:
        folder = entries["images"].folder or folder
    if source.transforms is not None:
        files = source.transforms if isinstance(source.transforms, tuple) else (source.transforms,)
        return name_by_images(read_transforms(entries["transforms"], files, every))
    if source.colmap is not None:
        read = read_colmap(entries["colmap"], source.colmap, path_in(folder, source.images or ""))
        return name_by_images(split_views(read, every))
    assert source.ring is not None
    cameras = ring_cameras(source.ring, up)
    images: list[Path] | list[None] = [None] * len(cameras)
    if source.images is not None:
        # Wildcards stand in the last two parts: those above may match without end.
        patterns = [source.images, source.images.replace("\\", "/")]  # as Windows writes it
        is_endless = glob.has_magic(str(Path(patterns[1]).parent.parent))
        names = [[]] if is_endless else [glob.glob(text, root_dir=folder) for text in patterns]
        matches = sorted(next(filter(None, names), []), key=in_order)
        if matches != sorted(matches, key=lambda name: in_order(name, DECIMAL)):
            what = "matches names with fractions or signs, whose order is not plain: count them"
            raise entries["images"].refused(f"{source.images!r} {what} 0, 1, 2, ...")
        images = [path for name in matches if (path := (folder / name).absolute()).is_file()]
        if len(images) != len(cameras):
            what = f"{source.images!r} matches {len(images)} files, but the ring has"
            raise entries["images"].refused(f"{what} {len(cameras)} cameras")
    views = [
        ViewSection(name=f"ring_{index:02d}", camera=camera, image=image)
        for index, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    return tuple(split_views(views, every))


def name_listed(node: Node, views: Sequence[ViewSection]) -> tuple[ViewSection, ...]:
    """The `views` of `node`, nameless ones called by their place; SceneError for equal names."""
    problems, first = Problems(), dict[str, int]()
    names = [view.name or f"view_{index:02d}" for index, view in enumerate(views)]
    for index, name in enumerate(names):
        if first.setdefault(name, index) != index:
            child = node.children()[index]
            what = f"{name!r} is already the name of view {first[name]}"
            problems.note(child.entries().get("name", child).refused(what))
    problems.raise_any()
    return tuple(replace(view, name=name) for view, name in zip(views, names, strict=True))


def name_by_images(views: Sequence[ViewSection]) -> tuple[ViewSection, ...]:
    """`views` with names, all different, by their images where they have some."""
    paths = [view.image or Path(f"view_{index:02d}") for index, view in enumerate(views)]
    # A frame's number is no part of a name: the view of frames/{frame:04d}.png is that of a folder.
    unnumbered = [FRAME.sub("", path.stem).strip("._-") or path.parent.name for path in paths]
    # Of long ones the ends, as file names have room for.
    stems, folders = (
        [re.sub(r"[^A-Za-z0-9_-]", "_", word)[-99:] for word in words]
        for words in (unnumbered, [path.parent.name for path in paths])
    )
    longer = [f"{folder}_{stem}" for folder, stem in zip(folders, stems, strict=True)]
    numbered = [f"{index:03d}_{stem}" for index, stem in enumerate(stems)]
    names = next(names for names in (stems, longer, numbered) if len(set(names)) == len(names))
    return tuple(replace(view, name=name) for view, name in zip(views, names, strict=True))


def ring_cameras(ring: RingSection, up: str) -> list[PerspectiveSection]:
    """Camera i of n stands at target + height u + r (cos(2 pi i/n) a + sin(2 pi i/n) u x a).

    u is the unit vector along the axis that is `up`, and a that of the axis after it.
    """
    upward, cameras = "xyz".index(up), list[PerspectiveSection]()
    for index in range(ring.count):
        turn, place = 2 * math.pi * index / ring.count, [*ring.target]
        place[upward] += ring.height
        place[(upward + 1) % 3] += ring.radius * math.cos(turn)
        place[(upward + 2) % 3] += ring.radius * math.sin(turn)
        camera = PerspectiveSection(fov=ring.fov, resolution=ring.resolution)
        x, y, z = place
        along = float(up == "x"), float(up == "y"), float(up == "z")
        cameras.append(replace(camera, origin=(x, y, z), target=ring.target, up=along))
    return cameras


def read_referenced(scene_file: SceneFile, key: str, path: Path, read: Callable[[Path], T]) -> T:
    """The content of the file `path` named at `key`, as `read` returns it.

    Raises SceneError if there is no such file, FormatError if it is unusable.
    """
    require(scene_file, key, path)
    return read(path)


def require(scene_file: SceneFile, key: str, path: Path) -> None:
    """Raises SceneError unless `path`, named at `key`, is a file."""
    try:
        is_file, exists = path.is_file(), path.exists()
    except OSError as error:
        fault = f"{path} cannot be reached: {error.strerror or error}"
        raise scene_file.refused(key, fault) from error
    if not is_file:
        raise scene_file.refused(key, f"{path} {'is not a file' if exists else 'does not exist'}")


def referenced_files(scene_file: SceneFile) -> list[Path]:
    """Every file that the scene names, each once, in the order of the scene."""
    return list(dict.fromkeys(file for file in walk(scene_file.tree) if isinstance(file, Path)))


def walk(value: Any) -> Iterator[Any]:
    """`value`, a tree, and all below."""
    yield value
    inner: Iterable[Any] = value if isinstance(value, tuple) else ()
    if isinstance(value, Mapping) or is_dataclass(value):
        inner = (value if isinstance(value, Mapping) else vars(value)).values()
    for entry in inner:
        yield from walk(entry)


def describe(scene_file: SceneFile) -> dict[str, Any]:
    """The resolved scene in plain mappings, lists, numbers and text."""
    return dict(_plain(scene_file.tree))


def dump_scene(described: dict[str, Any], path: Path) -> None:
    """Writes what `describe` returns to `path` as YAML that `read_scene` reads as the same tree."""
    with replace_file(path) as temporary:
        temporary.write_text(scene_text(described), encoding="utf-8")


def scene_text(described: dict[str, Any]) -> str:
    """What `dump_scene` writes."""
    layout: Any = {"sort_keys": False, "allow_unicode": True, "default_flow_style": None}
    text: str = yaml.dump(described, Dumper=_Dumper, width=10**6, **layout)
    return text


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        tag = {"type": value.type} if hasattr(value, "type") else {}
        entries = {key.name: getattr(value, key.name) for key in fields(value)}
        # Nor what belongs to an alternative that was not taken.
        groups = getattr(value, "ALTERNATIVES", ())
        left_out = {name for group in groups if entries[group[0]] is None for name in group}
        left_out |= {"g"} if entries.get("phase") is not None else set()
        return tag | {
            name: _plain(entry)
            for name, entry in entries.items()
            if entry is not None and name not in left_out
        }
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


class _Dumper(yaml.SafeDumper):
    """Quotes text that would be read as something else, as PyYAML goes by YAML 1.1; no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar(
        "tag:yaml.org,2002:str", text, style=None if resolve(text) == text else '"'
    ),
)
