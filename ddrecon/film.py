"""A film: a run's folder for each of its frames, driven one after another, and nothing is lost.

Cameras, exposures and lights do not change in a film: several frames together find them once, in
the calibration, and `shared.json` keeps them.
"""

import json
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from shutil import rmtree
from statistics import mean
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import (
    DataWarning,
    DdreconError,
    FormatError,
    SceneError,
    SolveError,
    UsageError,
)
from ddrecon.grid import Grid
from ddrecon.io.files.atomic import note_written, write_json
from ddrecon.io.files.folders import FILM, RUN, Folder, claim_folder
from ddrecon.io.files.reading import read_json
from ddrecon.io.images.table import read_image, webp_of
from ddrecon.io.volumes.field import Facts
from ddrecon.io.volumes.table import read_field, turn_up, write_fields
from ddrecon.numerics.flow import carry, find_flow
from ddrecon.pictures import encode_bytes
from ddrecon.progress import say
from ddrecon.ranks import own_rank, rank_count
from ddrecon.reconstruct.frame import Result
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.report.page import Plot, draw_curve, write_page
from ddrecon.report.pictures import pixels, shrink
from ddrecon.report.volumes import Shown, describe_volume, describe_world
from ddrecon.run.job import (
    CHECKPOINTS,
    PREVIOUS,
    Job,
    Outcome,
    fingerprint,
    has_checkpoint,
    require_same,
    work,
)
from ddrecon.run.report import list_numbers, psnr_text
from ddrecon.run.result import RESULT, poses_of, put_values
from ddrecon.run.run_folder import (
    LENGTHS,
    LOG,
    REPORT,
    SCENE,
    SUMMARY,
    Run,
    field_key,
    fields_to_export,
    read_log,
    store_value,
    volume_file,
    write_scene,
    write_volume,
)
from ddrecon.scene import Scene
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.build_views import Maker, at_frame, remove_pictures, require_frames
from ddrecon.scene_file.build_volume import build_media, cells_of
from ddrecon.scene_file.load import (
    SceneFile,
    describe,
    read_described,
    read_scene,
    referenced_files,
)
from ddrecon.scene_file.view_schema import FramesSection
from ddrecon.variables.kinds import kind_of
from ddrecon.variables.values import EVERY

MIXED = 0.2
"""The part of a frame's start that is mixed into its result: less noise and less flicker."""
MOST_APART = 3
"""Frames farther from each other know nothing of each other's motion."""
SHARED, SEQUENCE, VELOCITY = "shared.json", "sequence", "velocity"
"""The file of what frames share, the folder of exported volumes, `film_0000.vdb` and so on, and the
name of a frame's motion, and of its file."""

RECORD = "film.json"
KEYS = ("iterations", "seconds", "psnr", "ssim", "test_psnr", "test_ssim")
"""Entries of a run's summary that a film's record keeps of each frame."""
SHOWN = 48
"""Frames whose pictures and volumes are on the page; all are in their folders."""
WIDEST = 768
"""Pixels across target, render and difference, at most."""
PAUSE = 0.2
"""Seconds after which a rank looks again whether the film is calibrated."""
REPORT_SHARE = 0.05
"""While frames are made, their page takes no more than this part of the time."""


@dataclass
class Film:
    """The film that `scene_file` asks for, in the folder `path`.

    `build` makes the scene of a frame as tensors; `environment` and `preview_every` are as of a
    run. `shared` is what `shared.json` says.
    """

    scene_file: SceneFile
    path: Path
    build: Callable[[SceneFile], Scene]
    environment: dict[str, Any] = field(default_factory=dict)
    preview_every: int | None = None
    shared: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> FramesSection:
        """Which frames there are."""
        assert self.scene_file.tree.frames is not None
        return self.scene_file.tree.frames

    @cached_property
    def grid(self) -> Grid:
        """The grid of all frames."""
        media = build_media(Maker(self.scene_file))
        return next(iter(media.values())).grid

    @property
    def optimized(self) -> list[str]:
        """The variables that the film optimizes."""
        optimize = self.scene_file.tree.optimize
        return [*optimize.parameters] if optimize else []

    def of(self, number: int) -> Path:
        """The folder of the run of the frame `number`."""
        return self.path / "frames" / f"{number:04d}"

    def calibrated(self, number: int) -> Path:
        """The folder of the volumes that the frame `number` had in the calibration."""
        return self.path / "calibration" / f"{number:04d}"

    def done(self) -> list[int]:
        """The frames that are finished."""
        return [n for n in self.frames.numbers if (self.of(n) / SUMMARY).is_file()]

    def scene_of(self, number: int) -> SceneFile:
        """The scene of the frame `number`, with what is shared fixed.

        Its fields begin as those of a frame close before it, carried on, else as in the
        calibration, if any. They are written to its folder.
        """
        described = describe(at_frame(self.scene_file, number))
        fix_shared(described, self.shared.get("values", {}), self.path / SHARED)
        optimize, before = described["optimize"], self._before(number)
        source = self.calibrated(number) if before is None else self.of(before)
        fields = fields_in(source, [*optimize["parameters"]])
        if before is not None and (air := fields_in(source, [VELOCITY])):
            # The air goes on as it went, and its motion with it.
            displacement = air[VELOCITY].flip(0) / self._cell * (number - before)
            displacement = carry(displacement, displacement)
            fields = {name: carry(value, displacement) for name, value in fields.items()}
        start = self.of(number).absolute() / "start"
        for name, value in fields.items():
            file = start / write_volume(start, name, value, self.grid)
            optimize["parameters"][name]["init"] = {"file": str(file)}
        if fields:
            optimize["keep_start"] = MIXED
        return read_described(described, self.scene_file.path)

    def write_velocity(self, number: int) -> None:
        """Writes the motion of the frame `number` from the one before, [u] a frame, for blur.

        The first frame of a part has that of the second.
        """
        before, sums = self._before(number), list[Tensor]()
        if before is None:
            return
        for frame in (before, number):
            fields = fields_in(self.of(frame), self.optimized)
            moving = [name for name in fields if name.endswith("density")] or [*fields][:1]
            # Colors are averaged.
            sums.append(torch.stack([fields[name].mean(0) for name in moving]).sum(0))
        motion = find_flow(*sums) / (number - before) * self._cell
        for frame in (number, before):
            # Where another rank is writing, it writes this as well.
            with suppress(UsageError), claim_folder(self.of(frame), RUN, resume=True):
                if not volume_file(self.of(frame), VELOCITY).is_file():
                    write_volume(self.of(frame), VELOCITY, motion.flip(0), self.grid)

    def _before(self, number: int) -> int | None:
        """The last frame that is done close before the frame `number`."""
        far = MOST_APART * self.frames.step
        return max((n for n in self.done() if 0 < number - n <= far), default=None)

    @property
    def _cell(self) -> Tensor:
        """The sides of a cell [u] along z, y and x: [3, 1, 1, 1]."""
        return torch.tensor(self.grid.spacing).view(3, 1, 1, 1)


class Calibration(Job):
    """The job of what the frames `numbers` of a `film` share, found from them together."""

    def __init__(self, film: Film, numbers: Sequence[int]):
        self.film, self.numbers = film, numbers
        files = [at_frame(film.scene_file, number) for number in numbers]
        try:
            scenes = [film.build(scene_file) for scene_file in files]
            together = Reconstruction(scenes[0], others=scenes[1:])
            dtype = scenes[0].volume.density.dtype
            marks = [fingerprint(scene_file, dtype) for scene_file in files]
        except FormatError as error:
            advice = (
                f"frames {', '.join(map(str, numbers))} calibrate the film: change frames.first"
            )
            raise FormatError(error.path, f"{error.reason}; {advice} or frames.last") from error
        named = {f"frame {n}": mark for n, mark in zip(numbers, marks, strict=True)}
        super().__init__(together, f"calibrate by {len(numbers)} frames", named)

    def begin(self, folder: Folder, is_resumed: bool) -> None:
        """Nothing is to be made, nor to go."""

    def finish(self) -> Outcome:
        """Writes the volumes of these frames and what they share; its checkpoints go."""
        film, together = self.film, self.run
        scene, names = together.current_scene(), [p.name for p in together.shared]
        for number, frame in zip(self.numbers, together.frames, strict=True):
            for p in frame.parameters:
                if p.is_field:
                    grid = frame.problem.scene.volume.grid
                    write_volume(film.calibrated(number), p.name, p.value_on(grid), grid)
        values = {name: store_value(film.path, scene, name) for name in names}
        values |= poses_of(scene, names)
        numbers = list_numbers(together.shared, together.problem.scene, scene)
        texts = {name: text for name, _, text in numbers}
        content = {"frames": self.numbers, "values": values, "texts": texts}
        write_json(film.path / SHARED, content)
        rmtree(film.path / CHECKPOINTS)
        return content, []


def optimize_sequence(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    *,
    overrides: Iterable[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Iterator[Result]:
    """The frames of the film in the scene file at `path`, one after another as they are done.

    `folder` keeps it, and a film that was left there goes on; without one nothing is kept.
    `overrides` (`key.path=value`) are put in first. Raises as `open_film` and `drive_frames` do,
    and UsageError where another process writes to the folder.
    """
    with nullcontext(folder) if folder else TemporaryDirectory() as place:
        build = partial(build_scene, dtype=dtype, device=device)
        film = Film(read_scene(path, overrides), Path(place), build)
        if film.scene_file.tree.frames is None:
            raise SceneError(f"{path}: frames: missing section; say which, {{first: 0, last: 99}}")
        with claim_folder(film.path, FILM, resume=True) as claimed:
            for number in drive_frames(film, claimed, open_film(film, claimed, is_resumed=True)):
                scene = build(read_scene(film.of(number) / RESULT))
                yield Result(scene, read_log(film.of(number) / LOG))


def open_film(
    film: Film,
    folder: Folder,
    frame_range: str | None = None,
    shared: Path | None = None,
    *,
    is_resumed: bool,
) -> list[int]:
    """The frames of `film` within `frame_range`, for which its claimed `folder` is prepared.

    Its calibration may be `shared` from a file. An earlier film's files of these frames are
    removed, unless this one `is_resumed`. Raises UsageError where the folder holds another film, or
    another process writes to such a frame; SceneError where pictures are missing, or nothing is
    optimized.
    """
    scene_file, path = film.scene_file, film.path
    if not any(kind_of(name).is_cellwise for name in film.optimized):
        text = "optimize.parameters: none changes from frame to frame; name one, such as density"
        raise SceneError(f"{scene_file.path}: {text}")
    require_frames(scene_file)
    calibration = None if shared is None else read_shared(shared)
    chosen, old_scene = choose_frames(film.frames.numbers, frame_range), path / SCENE
    is_same = (is_resumed or frame_range is not None) and old_scene.is_file()
    if is_same:
        old, new = describe(read_scene(old_scene)), describe(scene_file)
        for scene in (old, new):
            scene.pop("frames", None)  # a film may grow
            scene.get("optimize", {}).pop("iterations", None)
        require_same(old, new, f"{path}: holds another film; use another output folder")
    write_scene(scene_file, path)
    if not is_resumed:
        folders = [f"frames/{number:04d}/" for number in chosen]
        folders += [f"{SEQUENCE}/film_{number:04d}." for number in chosen]
        inputs = [old_scene, scene_file.path, *referenced_files(scene_file)]
        inputs += [] if shared is None else [shared]
        folder.clear(inputs, folders if is_same else [""])
    if calibration is not None:
        file = path / SHARED
        if file.is_file() and read_shared(file)["values"] != calibration["values"]:
            raise UsageError(f"{file}: holds another calibration; leave --shared out")
        write_json(file, calibration)
    for number in film.frames.numbers:
        note_written(film.of(number), "/")
    return chosen


def drive_frames(film: Film, folder: Folder | None, numbers: Sequence[int]) -> Iterator[int]:
    """Yields the frames `numbers` of `film` as they are finished, after its calibration.

    A rank whose `folder` is None waits for the calibration of another. A frame that fails is named
    and left out; its error is raised when all others are done.
    """
    shared, failures = film.path / SHARED, list[DdreconError]()
    while film.frames.calibrate and not shared.is_file():
        if folder is None:
            sleep(PAUSE)
            continue
        job = Calibration(film, spread_out(film.frames.numbers, film.frames.calibrate))
        if job.run.shared:
            work(job, folder, has_checkpoint(film.path / CHECKPOINTS))
        else:
            write_json(shared, {"frames": [], "values": {}, "texts": {}})
    film.shared = read_shared(shared) if shared.is_file() else {}
    for number in numbers:
        try:
            _drive_frame(film, number)
        except (SolveError, FormatError, SceneError) as error:
            failures.append(error)
            first, *_ = str(error).splitlines()
            warnings.warn(f"frame {number}, left out: {first}", DataWarning, 2)
            continue
        yield number
    if failures:
        raise failures[0]


def _drive_frame(film: Film, number: int) -> None:
    """Finishes the frame `number`, from where it was."""
    path = film.of(number)
    if number not in film.done():
        with claim_folder(path, RUN, overwrite=True) as folder:
            is_resumed = has_checkpoint(path / CHECKPOINTS)
            scene_file = read_scene(path / SCENE) if is_resumed else film.scene_of(number)
            scene, title = film.build(scene_file), f"frame {number}"
            job = Run(scene, scene_file, film.environment, film.preview_every, title)
            work(job, folder, is_resumed)
            (path / CHECKPOINTS / PREVIOUS).unlink(missing_ok=True)
    if not volume_file(path, VELOCITY).is_file():
        film.write_velocity(number)


def export_film(film: Film, kind: str, up: str | None) -> None:
    """Writes all frames that are done as volumes of a `kind`, in which the axis `up` points up."""
    (film.path / SEQUENCE).mkdir(exist_ok=True)
    fps, upright = film.frames.fps, film.scene_file.tree.volume.up
    facts: Facts = {"units": f"{LENGTHS}; velocity [u/{'s' if fps else 'frame'}]"}
    facts = {**facts, "fps": np.array(fps)} if fps else facts
    for number in film.done():
        folder = film.of(number)
        scene = film.build(remove_pictures(read_scene(folder / RESULT), None))
        fields, constants, bounds = fields_to_export(scene)
        if (file := volume_file(folder, VELOCITY)).is_file():
            fields[VELOCITY] = read_field(file, VELOCITY).values * (fps or 1)
        path = film.path / SEQUENCE / f"film_{number:04d}.{kind}"
        turned = turn_up(fields, bounds, upright, up or upright)
        write_fields(path, *turned, {**facts, **constants})


def share_out(numbers: Sequence[int]) -> Sequence[int]:
    """This rank's share of the frames `numbers`, one after another; the first rank has some."""
    begin, end = (-(-len(numbers) * (own_rank() + more) // rank_count()) for more in (0, 1))
    return numbers[begin:end]


def spread_out(numbers: Sequence[int], count: int) -> list[int]:
    """`count` of the `numbers`, spread evenly from the first to the last."""
    last = len(numbers) - 1
    return [numbers[round(at)] for at in np.linspace(0, last, min(count, len(numbers)))]


def choose_frames(numbers: Sequence[int], frame_range: str | None) -> list[int]:
    """Those of the frames `numbers` within `frame_range`, `A:B`, both included; None is all.

    Raises UsageError where there are none.
    """
    ends = re.fullmatch(r"([0-9]*):([0-9]*)", frame_range or ":")
    first, last = (ends[1] or 0, ends[2] or numbers[-1]) if ends else (1, 0)
    chosen = [number for number in numbers if int(first) <= number <= int(last)]
    if not chosen:
        film = f"{numbers[0]}:{numbers[-1]}"
        raise UsageError(f"--frames {frame_range}: names no frame; expected a part of {film}")
    return chosen


def finished_frames(path: Path, frame_range: str | None) -> list[Path]:
    """The runs of finished frames of the film in the folder `path`, within `frame_range`.

    Raises UsageError where there are none.
    """
    finished = (file.parent for file in path.glob(f"frames/*/{SUMMARY}"))
    runs = {int(run.name): run for run in finished if run.name.isdecimal()}
    if not runs:
        raise UsageError(f"{path}: no frame is done")
    return [runs[number] for number in choose_frames(sorted(runs), frame_range)]


def fields_in(folder: Path, names: list[str]) -> dict[str, Tensor]:
    """Those of the variables `names` that are fields [C, z, y, x], as the run in `folder` has."""
    files = {name: volume_file(folder, name) for name in names}
    return {n: cells_of(read_field(f, field_key(n))) for n, f in files.items() if f.is_file()}


def read_shared(path: Path) -> dict[str, Any]:
    """What `path`, a `shared.json`, says. Raises UsageError and FormatError."""
    if not path.is_file():
        raise UsageError(f"--shared {path}: there is no such file; a film's folder has one")
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("values"), dict):
        raise FormatError(path, "has no 'values'; expected the shared.json of a film")
    values = content["values"]
    for name, value in values.items():
        if isinstance(value, str):
            values[name] = str((path.parent / value).absolute())
    return content


def fix_shared(described: dict[str, Any], values: Mapping[str, Any], source: Path) -> None:
    """Puts the `values`, by variable, that `source` says into the scene `described`.

    They are not optimized any more. Raises UsageError where these are of other cameras or lights.
    """
    views = {view["name"]: view for view in described["views"]}
    lights = (f"lights.{index}" for index in range(len(described["lights"])))
    owners = {*lights, *(f"views.{name}" for name in views), *({"ground"} & {*described})}
    for name in values:
        is_outside = name.startswith(("views.", "lights.", "ground."))
        if is_outside and name.rpartition(".")[0] not in owners:
            raise UsageError(f"{source}: {name}: the scene has none; name that of its cameras")
    train = [name for name, view in views.items() if view["split"] == "train" and "image" in view]
    for name in [*described["optimize"]["parameters"]]:
        keys = [name.replace(EVERY, f"views.{view}.") for view in train]
        names = dict.fromkeys(keys if name.startswith(EVERY) else [name])
        missing = [key for key in names if key not in values]
        if missing and len(missing) < len(names):
            raise UsageError(f"{source}: has no {missing[0]}; name that of the scene's cameras")
        if not missing:
            del described["optimize"]["parameters"][name]
    put_values(described, values)


def drive_film(
    film: Film, folder: Folder | None, numbers: Sequence[int], exported: str | None, up: str | None
) -> Outcome:
    """Tells of `film` after its frames `numbers`, of which those that are done stay.

    All that are done then are `exported` as volumes of this kind, in which the axis `up` points up.
    Raises as `drive_frames` does.
    """
    due, finished = 0.0, film.done()
    if stay := [str(number) for number in numbers if number in finished]:
        anew = f"--frames {stay[0]}:{stay[0]} --overwrite makes one anew"
        say(f"frames that are finished stay as they are: {', '.join(stay)} ({anew})")
    try:
        for number in drive_frames(film, folder, numbers):
            if number not in finished and monotonic() >= due:
                start = monotonic()
                write_film_report(film)
                due = monotonic() + (monotonic() - start) / REPORT_SHARE
    finally:
        outcome = write_film_report(film)
    if exported is not None:
        export_film(film, exported, up)
    return outcome


def write_film_report(film: Film) -> Outcome:
    """Tells of the frames of `film` that are done; writes the record, `film.json`, and a page."""
    rows, summaries = list[dict[str, Any]](), dict[int, dict[str, Any]]()
    for number in film.done():
        summary = summaries[number] = json.loads((film.of(number) / SUMMARY).read_text())
        row = {key: summary[key] for key in KEYS if summary[key] is not None}
        registered = summary.get("registered", {})
        row |= {f"registered_{key}": value for key, value in registered.items()}
        rows.append({"frame": number, **row})
    record: dict[str, Any] = {"asked": len(film.frames.numbers), "frames": rows}
    if values := film.shared.get("values"):
        record["values"] = values
    write_json(film.path / RECORD, record)
    if not rows:
        return record, ["no frame is done"]
    means = {key: mean(row[key] for row in rows if key in row) for key in rows[0]}
    registered = {
        key.removeprefix("registered_"): value
        for key, value in means.items()
        if key.startswith("registered_")
    }
    lead = (
        f"{len(rows)} of {record['asked']} frames, {means['seconds']:.1f} s each: "
        f"{psnr_text({**means, 'registered': registered})}"
    )
    numbers = [*summaries][:: -(-len(summaries) // SHOWN)]
    write_page(
        film.path / REPORT,
        title=f"ddrecon: {film.path.absolute().name}",
        lead=lead,
        goes_on=len(rows) < record["asked"],
        plots={"heading": "Quality", "drawn": _curves(rows)},
        volume=_volumes(film, numbers),
        frames={"numbers": numbers, "strips": _figures(film, summaries, numbers)},
        numbers=_calibration(film.shared) if values else None,
    )
    return record, [lead]


def _curves(rows: Sequence[Mapping[str, Any]]) -> list[Plot]:
    drawn, kinds = [], {"trained on": "", "held out": "test_", "registered": "registered_"}
    for title, key in (("PSNR [dB]", "psnr"), ("SSIM", "ssim")):
        series = {
            name: [(float(row["frame"]), row[kind + key]) for row in rows if kind + key in row]
            for name, kind in kinds.items()
        }
        drawn.append(draw_curve(title, {n: s for n, s in series.items() if s}, "frame"))
    return drawn


def _volumes(film: Film, numbers: Sequence[int]) -> dict[str, Any]:
    """The fields of the frames `numbers`, and what stands around them by the last one."""
    last = remove_pictures(read_scene(film.of(numbers[-1]) / RESULT), None)
    fields = [
        Shown(name, "result", value, number)
        for number in numbers
        for name, value in fields_in(film.of(number), film.optimized).items()
    ]
    world = describe_world(film.grid, film.build(last))
    return describe_volume(fields, world, (), fields[0].name)


def _figures(
    film: Film, summaries: Mapping[int, Mapping[str, Any]], numbers: Sequence[int]
) -> list[list[tuple[bytes, str]]]:
    """Pictures of the views held out, or of the first one, in the frames `numbers`."""
    views = next(iter(summaries.values()))["views"]
    names = [name for name, view in views.items() if view["split"] == "test"] or [*views][:1]
    strips: list[list[tuple[bytes, str]]] = [[] for _ in names]
    for name, strip in zip(names, strips, strict=True):
        for number in numbers:
            stored = read_image(film.of(number) / "previews" / f"{name}.png").pixels
            image = shrink(torch.from_numpy(stored).permute(2, 0, 1), WIDEST)
            psnr = summaries[number]["views"][name]["psnr"]
            caption = f"{name}, frame {number}: {psnr:.2f} dB"
            strip.append((webp_of(encode_bytes(pixels(image))), caption))
    return strips


def _calibration(shared: Mapping[str, Any]) -> dict[str, Any]:
    """What all frames share."""
    texts, frames = shared.get("texts", {}), ", ".join(map(str, shared.get("frames", [])))
    return {
        "heading": "Calibration",
        "head": ["number", "value"],
        "rows": [(name, texts.get(name, f"in {SHARED}")) for name in shared["values"]],
        "text": f"Found from frames {frames} together.",
    }
