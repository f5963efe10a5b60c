"""What an earlier run has left in a folder is removed before another writes there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from ddrecon.errors import SceneError
from ddrecon.io.files.atomic import refusals
from ddrecon.scene_file.load import SceneFile, read_scene, referenced_files
from ddrecon.variables.kinds import FIELDS, PHASE

CHECKPOINT_FILES = ("checkpoints/last.pt", "checkpoints/previous.pt")
SAMPLE_FILES = (
    *("uncertainty.json", "report.html", *CHECKPOINT_FILES),
    *(f"volumes/*_{kind}.*" for kind in ("std", "mean", "told")),
    "samples/[0-9][0-9][0-9][0-9]/*",
)
"""What files of `ddrecon uncertainty` are called."""
RUN_FILES = (
    *("scene.yaml", "result.yaml", "environment.json", "parameters.json", "summary.json"),
    *("loss.csv", "report.html", *CHECKPOINT_FILES),
    *("lights.[0-9]*.*.npy", "lights.[0-9]*.*.exr", "lights.[0-9]*.*.tif"),
    *("previews/*.slices.png", "previews/*.[0-9][0-9][0-9][0-9][0-9][0-9].png"),
    *(f"uncertainty/{name}" for name in SAMPLE_FILES),
)
"""What files of `ddrecon optimize` are called, but for those named after media and views."""


def remove_samples(folder: Path) -> None:
    """Removes what `ddrecon uncertainty` has written to `folder`; raises FormatError."""
    _remove(folder, SAMPLE_FILES, ())


def remove_run(folder: Path, scene_file: SceneFile) -> None:
    """Removes what `ddrecon optimize` has written to `folder`, but for what `scene_file` reads.

    Raises FormatError where the system refuses.
    """
    kept = {path.resolve() for path in (scene_file.path, *referenced_files(scene_file))}
    _remove(folder, [*RUN_FILES, *_names_by_scene(folder)], kept)


def _names_by_scene(folder: Path) -> Iterator[str]:
    """Files named after the media and the views of the scene that the run in `folder` had."""
    try:
        tree = read_scene(folder / "scene.yaml").tree
    except SceneError:
        return
    for medium in ("", *(f"{name}." for name in getattr(tree.volume, "media", ()))):
        yield from (f"volumes/{medium}{name.removeprefix(PHASE)}.npz" for name in FIELDS)
    yield from (f"previews/{view.name}.png" for view in tree.views)


def _remove(folder: Path, names: Iterable[str], kept: Iterable[Path]) -> None:
    """Removes the files of these `names` in `folder`, and the folders within that this empties."""
    with refusals(folder):
        found = {path for name in names for path in folder.glob(name) if path.is_file()}
        for path in found:
            if path.resolve() not in kept:
                path.unlink()
    within = {parent for path in found for parent in path.parents if folder in parent.parents}
    for parent in sorted(within, reverse=True):
        with suppress(OSError):  # it holds something else
            parent.rmdir()
