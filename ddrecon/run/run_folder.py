"""The folder a reconstruction writes: log, volumes, pictures, checkpoints, summary and report."""

import csv
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, fields
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning, FormatError, SceneError, UsageError, is_utf8
from ddrecon.grid import Grid
from ddrecon.io.files.atomic import flush, refusals, replace_file, write_json
from ddrecon.io.files.folders import Folder
from ddrecon.io.images.table import write_linear, write_preview
from ddrecon.io.volumes.field import Fields
from ddrecon.io.volumes.table import write_field
from ddrecon.progress import say, tell
from ddrecon.reconstruct.frame import Row
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.support import describe_support, support_text
from ddrecon.report.pictures import comparison, slices
from ddrecon.run.job import CHECKPOINTS, Job, Outcome, fingerprint, load_checkpoint, restore
from ddrecon.run.quality import Findings, describe_loss, diagnose, find_results, loss_text
from ddrecon.run.report import FINER, GOES_ON, list_numbers, psnr_text, write_run_report
from ddrecon.run.result import RESULT, describe_result, plain, poses_of, result_names
from ddrecon.scene import Scene
from ddrecon.scene_file.load import (
    SceneFile,
    describe,
    dump_scene,
    read_scene,
    referenced_files,
    scene_text,
)
from ddrecon.variables.kinds import CROSS_SECTIONS, PHASE, is_of_volume, kind_of, split_name
from ddrecon.variables.values import density_names, fields_of, value_of, variable_names

PAGE_SECONDS, PAGE_SHARE = 20.0, 0.02
"""The report is written about this often, and takes at most this part of the run's time."""
SCENE, LOG, REPORT, SUMMARY = "scene.yaml", "loss.csv", "report.html", "summary.json"
"""The resolved scene of a run, its log, its page, and the file that is written last: a run that has
it is finished."""
ROUNDING = 1e-6
"""Relative rounding below which cells count as equal: one cross section follows from others."""
LENGTHS = "sigma_t [1/u], where [u] is the unit of length of the grid"
"""What a file says of the units of lengths; density times sigma_t is the extinction."""


class Run(Job):
    """The job of reconstructing the `scene` of a `scene_file` in an `environment`.

    Pictures are written each `preview_every` iterations; a `frame` of a film, which this names,
    says less. Raises SceneError for a scene that cannot be reconstructed.
    """

    def __init__(
        self,
        scene: Scene,
        scene_file: SceneFile,
        environment: Mapping[str, Any],
        preview_every: int | None = None,
        frame: str = "",
    ):
        try:
            with tell(f"{frame or 'optimize'}: looking at what the pictures show"):
                run = Reconstruction(scene)
        except SceneError as error:
            problems = [f"{scene_file.path}: {problem}" for problem in error.problems]
            raise SceneError(problems) from None
        result_of = fingerprint(scene_file, scene.volume.density.dtype)
        super().__init__(run, frame or "optimize", result_of)
        self.scene_file, self.environment, self.is_frame = scene_file, environment, bool(frame)
        self.preview_every, self.cells = preview_every, 0
        self.path: Path | None = None
        self.next_page = monotonic() + PAGE_SECONDS

    def begin(self, folder: Folder, is_resumed: bool) -> None:
        """Writes the scene to the folder; cuts the log to end where the run does."""
        self.path, run = folder.path, self.run
        if run.iteration > run.schedule.most:
            advice = "ask for more than that, in all, with --iterations"
            raise UsageError(f"{self.path}: {run.iteration} iterations are made already; {advice}")
        write_scene(self.scene_file, self.path)
        if not is_resumed:
            inputs = referenced_files(self.scene_file)
            folder.clear([self.scene_file.path, self.path / SCENE, *inputs])
        with refusals(self.path):
            for name in ("volumes", "previews"):
                (self.path / name).mkdir(exist_ok=True)
        write_json(self.path / "environment.json", self.environment)
        write_log(
            self.path / LOG, [r for r in read_log(self.path / LOG) if r.iteration <= self.iteration]
        )
        if not self.is_frame:
            say(loss_text(describe_loss(run.problem.settings, run.problem.train)))

    def step(self) -> str:
        """Makes an iteration and its row of the log; how near its pictures are.

        Now and then it writes the report of the run so far.
        """
        row = self.run.step()
        if self.path is None:
            return ""
        write_log(self.path / LOG, [row], is_more=True)
        if self.cells not in (0, row.cells) and not self.is_frame:
            say(f"iteration {row.iteration}: {row.cells:,} cells from here; {FINER}")
        self.cells = row.cells
        if self.preview_every and row.iteration % self.preview_every == 0:
            write_previews(self.path, find_results(self.run), f".{row.iteration:06d}")
        start = monotonic()
        if start >= self.next_page and not self.is_done:
            findings = find_results(self.run)
            self._report(findings, self._summary(findings) | {"ended": GOES_ON, "diagnoses": []})
            self.next_page = monotonic() + max(PAGE_SECONDS, (monotonic() - start) / PAGE_SHARE)
        test_psnr = self.run.total.test_psnr
        return f"PSNR {row.psnr:.1f}{'' if test_psnr is None else f'/{test_psnr:.1f}'} dB"

    def state(self) -> dict[str, Any]:
        """That of the run; the log has all rows that it counts."""
        if self.path is not None:
            flush(self.path / LOG)
        return super().state()

    def finish(self) -> Outcome:
        """Writes volumes, parameters, result, pictures and report, and tells the summary."""
        assert self.path is not None
        run, path = self.run, self.path
        findings = find_results(run, is_last=True)
        scene, support = findings.scene, run.problem.support
        names = result_names([parameter.name for parameter in run.parameters])
        stored = dict.fromkeys([*density_names(scene), *names])
        values = {name: store_value(path, scene, name) for name in stored}
        dump_scene(describe_result(self.scene_file, scene, values), path / RESULT)
        write_json(path / "parameters.json", _list_parameters(path, scene, values))
        write_previews(path, findings, "")
        summary = self._summary(findings) | {"views": findings.quality}
        fall, doubt = (run.iteration, run.search.gain), summary.get("support", {}).get("doubt")
        ended, misfit = summary["ended"], 1.0
        if ended["kind"] == "rest":
            misfit = ended["residual"] / ended["noise"]
        summary["diagnoses"] = diagnose(findings, *fall, support, doubt, misfit)
        self._report(findings, summary)
        write_json(path / SUMMARY, summary)
        lines = [
            f"{summary['iterations']} iterations in {summary['seconds']:.1f} s: loss "
            f"{summary['loss']:.4g}, {psnr_text(summary)}, of {summary['compared']}"
        ]
        lines += [support_text(summary["support"])] if "support" in summary else []
        lines += [] if summary["ended"]["kind"] == "iterations" else [summary["ended"]["text"]]
        return summary, [*lines, *(diagnosis["text"] for diagnosis in summary["diagnoses"])]

    def _summary(self, findings: Findings) -> dict[str, Any]:
        problem, total = self.run.problem, dict(vars(self.run.total))
        summary = {"iterations": total.pop("iteration"), **total, **findings.means()}
        summary |= describe_loss(problem.settings, problem.train)
        if problem.loss == "photon":
            summary["noise"] = {name: vars(noise) for name, noise in problem.noises.items()}
        summary["ended"] = self.run.ending()
        if problem.support is not None:
            summary["support"] = describe_support([problem.support], problem.scene.volume.grid)
        return summary

    def _report(self, findings: Findings, summary: Mapping[str, Any]) -> None:
        assert self.path is not None
        rows = [row for row in read_log(self.path / LOG) if row.iteration <= self.iteration]
        if len(rows) < self.iteration:
            text = f"{self.path / LOG}: has {len(rows)} of the {self.iteration} iterations made"
            warnings.warn(text, DataWarning, 2)
        numbers = list_numbers(self.run.parameters, self.run.problem.scene, findings.scene)
        write_run_report(self.path / REPORT, findings, rows, summary, self.environment, numbers)


def load_run(folder: Path, build: Callable[[torch.dtype], Scene]) -> Reconstruction:
    """The run in `folder` as it was saved last; `build` makes its scene, of a precision.

    Raises UsageError where the folder holds no run, FormatError where it is damaged.
    """
    if not (folder / SCENE).is_file() or not (folder / LOG).is_file():
        raise UsageError(f"{folder}: holds no run, as `ddrecon optimize -o` makes it")
    state, loaded = load_checkpoint(folder / CHECKPOINTS)
    run = Reconstruction(build(state["search"]["values"].dtype))
    restore(run, state, loaded)
    return run


def read_log(path: Path) -> list[Row]:
    """The readable rows of the log at `path`."""
    try:
        _, *lines = path.read_text(errors="replace").splitlines() or [""]
    except OSError:
        return []
    return [row for row in map(_read_row, lines) if row is not None]


def _read_row(line: str) -> Row | None:
    """What `line` says; None where it is not whole, or no number stands where one should."""
    read: dict[Any, Any] = {"int": int, "float": float}
    read["float | None"] = lambda cell: float(cell) if cell else None
    try:
        cells = zip(fields(Row), line.split(","), strict=True)
        return Row(*(read[column.type](cell) for column, cell in cells))
    except ValueError:
        return None


def write_log(path: Path, rows: Iterable[Row], is_more: bool = False) -> None:
    """Writes the log of `rows` to `path`, or adds them to what is there where they are more."""
    cells = [[f"{x:.8g}" if isinstance(x, float) else x for x in astuple(row)] for row in rows]
    if is_more:
        with refusals(path), path.open("a", newline="") as stream:
            csv.writer(stream).writerows(cells)
        return
    with replace_file(path) as temporary, temporary.open("w", newline="") as stream:
        csv.writer(stream).writerows([[column.name for column in fields(Row)], *cells])


def write_previews(folder: Path, findings: Findings, mark: str) -> None:
    """Writes middle slices of fields, and views beside their targets, to previews/NAMEmark.png."""
    for name, value in fields_of(findings.scene).items():
        write_preview(folder / "previews" / f"{name}.slices{mark}.png", slices(value))
    for view in findings.seen:
        assert view.image is not None
        beside = comparison(view.image, findings.images[view.name])
        write_preview(folder / "previews" / f"{view.name}{mark}.png", beside)


def write_scene(scene_file: SceneFile, folder: Path) -> None:
    """Writes the resolved scene to `folder`; UsageError where the scene file itself would go.

    One that was written there, and not changed since, may be read and go. Raises FormatError for
    files that no scene file can name.
    """
    path = folder / SCENE
    for file in referenced_files(scene_file):
        if not is_utf8(file):
            raise FormatError(file, "cannot be named in scene.yaml: it is not UTF-8; rename it")
    if path.resolve() == scene_file.path.resolve():
        text = path.read_text(encoding="utf-8")
        if text != scene_text(describe(read_scene(path))):
            raise UsageError(f"{path}: was changed and would be replaced; name a copy elsewhere")
    dump_scene(describe(scene_file), path)


def _list_parameters(folder: Path, scene: Scene, stored: Mapping[str, Any]) -> dict[str, Any]:
    """Everything of `scene` that is not a field, as plain values.

    Maps become files of their own, but for those that are `stored`.
    """
    parameters = dict[str, Any]()
    for name in variable_names(scene):
        value = value_of(scene, name)
        if value.ndim < 3:
            parameters[name] = value.tolist()
        elif not kind_of(name).is_cellwise:
            parameters[name] = stored.get(name) or store_value(folder, scene, name)
    return parameters | poses_of(scene, parameters)


def store_value(folder: Path, scene: Scene, name: str) -> Any:
    """The value of a variable as plain numbers, or where its file is, which is written here."""
    value = value_of(scene, name)
    if value.ndim < 3:
        return plain(value)
    if not kind_of(name).is_cellwise:
        return write_values(folder / name, name, value, scene.volume.grid, is_map=True)
    return {"file": write_volume(folder, name, value, scene.volume.grid)}


def field_key(name: str) -> str:
    """What a volume file calls the field `name`."""
    return split_name(name)[1].removeprefix(PHASE)


def volume_file(folder: Path, name: str) -> Path:
    """Where a run in `folder` keeps the field `name`."""
    medium = split_name(name)[0].removeprefix("media.")
    return folder / "volumes" / f"{medium}{field_key(name)}.npz"


def write_volume(folder: Path, name: str, value: Tensor, grid: Grid) -> str:
    """Where in the run's `folder` the field `name` is, which is written there."""
    file = volume_file(folder, name)
    file.parent.mkdir(parents=True, exist_ok=True)
    return f"volumes/{write_values(file.with_suffix(''), field_key(name), value, grid)}"


def write_values(stem: Path, key: str, value: Tensor, grid: Grid, is_map: bool = False) -> str:
    """The name of the file at `stem`, to which a field on `grid` is written under its `key`.

    It is [z, y, x] or [C, z, y, x]; a map of radiance [C, h, w] becomes pixels.
    """
    if is_map:
        write_linear(stem, value.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy())
        return f"{stem.name}.npy"
    file, box = stem.with_name(f"{stem.name}.npz"), np.array(grid.bounds_xyz)
    write_field(file, key, _channels_last(value), box)
    return file.name


def _channels_last(value: Tensor) -> np.ndarray:
    """A field [z, y, x] or [C, z, y, x] as files have it: [z, y, x] or [z, y, x, 3]."""
    array = value if value.ndim == 3 else value.permute(1, 2, 3, 0).squeeze(-1)
    return array.detach().float().cpu().numpy()


def fields_to_export(scene: Scene) -> tuple[dict[str, np.ndarray], Fields, np.ndarray]:
    """What differs from cell to cell, what is the same everywhere, and the box, of `scene`.

    Density is always among the first; of cross sections there are sigma_t and albedo, which
    programs of film and games take. Fields are [z, y, x] or [z, y, x, 3], constants have one number
    or three, and the box [2, 3] is its corners (x, y, z).
    """
    varied, constants = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name in variable_names(scene):
        if not is_of_volume(name) or name in CROSS_SECTIONS:
            continue
        value = value_of(scene, name).detach().float().cpu()
        if value.ndim >= 3:
            low, high = value.flatten(-3).aminmax(dim=-1)
            if split_name(name)[1] == "density" or (high - low > ROUNDING * high.abs()).any():
                varied[name] = _channels_last(value)
                continue
            value = (low + high) / 2
        if value.numel() in (1, 3):
            constants[name] = value.numpy()
    return varied, constants, np.array(scene.volume.grid.bounds_xyz)
