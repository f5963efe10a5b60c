"""Makes scene_file.md and expert_keys.md, the manual of scene files, and scene.schema.json.

Keys, kinds, limits and defaults are those the program checks. Run it after each change of them:

    python docs/make_scene_file.py
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from ddrecon import settings
from ddrecon.records import alternatives, type_hints
from ddrecon.scene_file import schema
from ddrecon.scene_file.read import describe_type
from ddrecon.variables.kinds import DENSITY_STEP, KINDS, Kind

FOLDER = Path(__file__).parent
EXPERT = """\
# Keys for experts

No scene needs them: they choose between ways to compute the same, for comparisons and experiments.
They stand in the sections of [the scene file](scene_file.md) that are named here.
`ddrecon check` tells which of them are not at their default."""
INTRODUCTION = """\
Every key, with what it takes, its limits and its default, made from the program's own schema.

- Vectors are x, y, z.
- Lengths are in a world unit u of your choice.
- `1e-3` is a number.
- Paths are relative to the scene file; those of `-D` and `--light` to the current folder.
- Three equal colors are rendered as one, unless they are optimized.

Anything unknown, repeated or out of its limits is refused with file, line, column and key.
[Keys for experts](expert_keys.md) have a page of their own.
Small scenes with other phase functions, models and losses are in `configs/kinds`.

Editors that know YAML complete and check keys by [scene.schema.json](scene.schema.json).
Its place is the file's first line: `# yaml-language-server: $schema=PATH/scene.schema.json`."""
VOLUME = """\
The box, and what is in it.
Give either `sigma_a` and `sigma_s`, or `sigma_t` and `albedo`."""
SECTIONS: list[tuple[str, type, str, dict[str, str]]] = [
    (
        "volume",
        schema.VolumeSection,
        VOLUME,
        {
            "density": (
                "What scatters and absorbs, per cell; everything else is multiplied by it. "
                "`{constant: 0.1}` is the same as `0.1`."
            ),
            "bounds": (
                "The corners of the box [u], `{min: [x, y, z], max: [x, y, z]}`; of the field's "
                "file where left out. `auto`: what fits the pictures."
            ),
            "resolution": (
                "Cells along x, y and z; those of the field's file where left out. `auto`: two "
                "pixels wide."
            ),
            "up": (
                "The axis along which heights count, those of a `ground`, of `heights` and of "
                "rings, and that `export --up` turns."
            ),
            "index": (
                "Refractive index inside the box, whose flat faces refract and reflect light; "
                "outside it is 1. Not with a ground, point lights or cameras inside."
            ),
            "periodic": (
                "The axes, one or two, along which the volume repeats without end, as `[x, z]` "
                "([E2.15](theory.md#2-the-forward-model)). Lights are directional, ambient or "
                "maps; the diffusion is `p1` by the scheme `conservative`, or none."
            ),
            "sigma_a": "Absorption coefficient per unit of density [1/u].",
            "sigma_s": "Scattering coefficient per unit of density [1/u].",
            "sigma_t": (
                "Extinction coefficient per unit of density [1/u]: absorption and scattering "
                "together."
            ),
            "albedo": "Single-scattering albedo: the part of the extinction that scatters.",
            "g": (
                "Mean cosine of the scattering angle (asymmetry parameter) of the "
                "Henyey-Greenstein phase function; above 0 is forward. The short form of `phase`. "
                "A file gives it cell by cell."
            ),
            "phase": "How light is scattered by angle, in place of `g`; see below.",
            "effective_radius": (
                "Of droplets, `phase: {type: mie, ...}`, where it differs by cell [micrometers]: "
                "mixtures of the smallest and the largest; 0 where there are none."
            ),
            "emission": (
                "Radiance that a unit of length emits [radiance/u], whatever the density. As a "
                "parameter that starts from 0 it is a field, one number a color."
            ),
            "temperature": (
                "In place of `emission`, of a black body [K]: absorption times its radiance, of "
                "luminance 1 at 1500 K ([E2.11](theory.md#2-the-forward-model))."
            ),
        },
    ),
    (
        "volume: {media: ...}",
        schema.MixtureSection,
        "Two media in the same box, in place of `density`, sections and `phase`.\n"
        "Their parameters are `media.NAME.density` and so on.",
        {
            "media": "Two media by names of your choice; see below.",
            "bounds": "As of one medium.",
            "resolution": "As of one medium.",
            "up": "As of one medium.",
            "periodic": "As of one medium.",
        },
    ),
    (
        "volume.media.NAME",
        schema.MediumSection,
        "One of them, as a volume of one medium is.\n"
        "Give either `sigma_a` and `sigma_s`, or `sigma_t` and `albedo`.",
        {
            "density": "Per cell, or the same everywhere.",
            "sigma_a": "Absorption coefficient per unit of density [1/u].",
            "sigma_s": "Scattering coefficient per unit of density [1/u].",
            "sigma_t": "Extinction coefficient per unit of density [1/u].",
            "albedo": "The part of the extinction that scatters.",
            "g": "The short form of `phase`.",
            "phase": "Any but `two_lobe`; its numbers are the same in all cells.",
        },
    ),
    (
        "volume.density, sigma_a, ...: {file: ...}",
        settings.FieldFile,
        "A field from a volume file, in one of these [formats](formats.md).",
        {
            "file": "Relative to the scene file.",
            "name": "The field's name in the file, where that is not its name here.",
        },
    ),
    (
        "volume.density, sigma_a, ...: {heights: ...}",
        schema.Profile,
        "Values by height, such as those of a gas; `media` has how air stands beside a cloud.",
        {
            "heights": "Along `volume.up` [u], each above the one before.",
            "values": "One at each height; linear between them, and even beyond.",
        },
    ),
    (
        "volume.sigma_t: {meters: ...}",
        schema.Water,
        "Of droplets, `phase: {type: mie, ...}`: 1.5 / effective radius [micrometers] per meter, "
        "twice their cross section.\n`density` is then their liquid water [g/m3].",
        {"meters": "How many a u has: 1000 where lengths are in kilometers."},
    ),
    (
        "volume.phase: {type: henyey_greenstein}",
        schema.HenyeyGreensteinSection,
        "The usual phase function of one number; `g: 0.3` is short for it.",
        {"g": "Mean cosine of the scattering angle; above 0 is forward. A file has one a cell."},
    ),
    (
        "volume.phase: {type: two_lobe}",
        schema.TwoLobeSection,
        "A mixture of two Henyey-Greenstein functions: haze and smoke, which scatter backward too.",
        {
            "g": "The mean cosine of each.",
            "weight": "The part of the first; a file has one a cell.",
        },
    ),
    (
        "volume.phase: {type: rayleigh}",
        schema.RayleighSection,
        "Air, and other particles much smaller than the wavelength.\nIt has no numbers.",
        {},
    ),
    (
        "volume.phase: {type: table}",
        schema.TableSection,
        "Values over the angle, of any scale; see [your data](your_data.md#phase-functions).",
        {
            "file": (
                ".csv or .txt with a header: `angle` (degrees) or `cosine`, then one column of "
                "values or one a color."
            ),
        },
    ),
    (
        "volume.phase: {type: mie}",
        schema.MieSection,
        "Droplets whose radii follow a gamma distribution, by Mie's theory.\n"
        'Needs miepython: `pip install "ddrecon[mie]"`.',
        {
            "wavelength": "In micrometers, one for each color.",
            "refractive_index": "Of the droplets; of water 1.33.",
            "effective_radius": "In micrometers: of clouds 5 to 15; or `volume.effective_radius`.",
            "effective_variance": "Of the distribution: of clouds about 0.1.",
        },
    ),
    (
        "ground",
        schema.GroundSection,
        "An unbounded plane under the box that reflects light evenly into all directions.\n"
        "Cameras see it, in shadow and in the light of the volume, and it lights the volume.",
        {
            "height": "Along `volume.up` [u]: at the bottom of the box, or below.",
            "albedo": (
                "The part of the light that it reflects; `ground.albedo` can be optimized. A file "
                "is a picture, or `.npy`, of what is straight under the box, `[z, x]` (`[y, x]` "
                "with `up: z`) from low to high as in volume files; beyond it is its mean."
            ),
        },
    ),
    (
        "lights: {type: directional}",
        schema.DirectionalSection,
        "Parallel light, such as the sun's.",
        {
            "direction": "The direction in which the light travels, of any length.",
            "irradiance": "On a plane that faces it, in units of radiance times steradian.",
        },
    ),
    (
        "lights: {type: ambient}",
        schema.AmbientSection,
        "The same light from everywhere.",
        {
            "radiance": "Of every direction.",
        },
    ),
    (
        "lights: {type: environment}",
        schema.EnvironmentSection,
        "A latitude-longitude map (HDRI), oriented as Mitsuba's `envmap`.\n"
        "Small bright regions become suns.",
        {
            "file": "An image of linear radiance: .exr, .hdr, .npy, .tif.",
            "scale": "Factor on its pixels.",
            "rotation": "About the pole, in degrees.",
            "directions": (
                "Directions into which its light on the volume is gathered; more are slower and "
                "more exact."
            ),
            "up": (
                "Where the pole is, the map's first row. "
                "With z, what the map holds at (x, y, z) is at (x, -z, y)."
            ),
        },
    ),
    (
        "lights: {type: point}",
        schema.PointSection,
        "Light from a point, inside or outside the box.",
        {
            "position": "Where it is [u].",
            "intensity": "Power per solid angle.",
        },
    ),
    (
        "lights: {type: beam}",
        schema.BeamSection,
        "A collimated Gaussian beam, such as a laser's, that comes from outside the box.",
        {
            "position": "A point on its axis [u]; where on it does not matter.",
            "direction": "The direction in which it travels, of any length.",
            "power": "Of the whole beam.",
            "radius": (
                "Where irradiance is 1/e^2 of that on the axis [u]. 0 is a pencil: its radius is "
                "half the longest side of a cell, and no beam is thinner."
            ),
        },
    ),
    (
        "views",
        schema.ViewSection,
        "A list of pictures, or of cameras to render.\n"
        "Or a ring, or NeRF cameras: see the next table.",
        {
            "name": "Files of the view have this name.",
            "camera": "Where it is seen from; see below.",
            "image": (
                "The picture: .exr, .hdr, .npy and float .tif are linear, .png, .jpg, .webp and "
                "films (.mp4, .mov, .mkv, .webm) are decoded from sRGB; alpha 0 is empty."
            ),
            "mask": "A picture of the same size, white where pixels count, else black.",
            "frame": (
                "Of a film, which frame is taken, counted from 0. With `frames`, the one that the "
                "scene's frame 0 is."
            ),
            "time": "Seconds after which a film begins here: `frame` counts from there.",
            "split": "`test` views are never optimized on, and always reported.",
            "weight": "How much a training view counts.",
            "exposure": (
                "The picture is this times radiance. As a parameter, the mean over all training "
                "views is held."
            ),
            "offset": "And this is added: a black level, or haze of the lens.",
            "background": (
                "What the picture shows where the volume is empty: a picture without it, or a "
                "color. Unless given, the lights behind it, or black."
            ),
            "noise": "How this picture errs; see `optimize.noise` below.",
        },
    ),
    (
        "views: {ring: ...}, {transforms: ...} or {colmap: ...}",
        schema.ViewSource,
        "Views that are not listed one by one.",
        {
            "ring": "Cameras in a circle; see below.",
            "transforms": "`transforms.json` of NeRF, instant-ngp or nerfstudio, read as it is.",
            "colmap": "Folder of COLMAP's sparse model, such as `sparse/0`; text or binary.",
            "images": (
                "For a ring: a pattern such as `targets/train_*.exr`, whose files, sorted by the "
                "numbers in their names, belong to the cameras in turn. For COLMAP: the folder of "
                "its pictures."
            ),
            "test_every": (
                "One view in this many, the first of them, is a test view, where transforms do "
                "not say which are."
            ),
        },
    ),
    (
        "views: {ring: ...}",
        schema.RingSection,
        "Cameras around `target`: where y is up, the first towards +z of it, the next towards +x.\n"
        "Where z is up they are +x and +y.",
        {
            "count": "How many.",
            "radius": "Of the circle [u].",
            "fov": "Horizontal field of view, in degrees.",
            "height": "Of the circle above the target, along `up` [u].",
            "target": "What they look at [u].",
            "up": "What the circle lies around, and up in their images; `volume.up` unless given.",
            "resolution": "Width and height in pixels; left out where there are images.",
        },
    ),
    (
        "camera: {type: perspective}",
        schema.PerspectiveSection,
        "A pinhole camera.\nGive either `origin`, `target` and `up`, or `matrix`.",
        {
            "fov": "Horizontal field of view, in degrees.",
            "principal_point": (
                "Where the axis meets the image, as parts of its width and height from the top "
                "left."
            ),
            "pixel_aspect": "Height of a pixel over its width.",
            "distortion": "Of its lens; see below. Left out, there is none.",
            "origin": "Where the camera stands [u].",
            "target": "A point on its axis [u].",
            "up": "The direction that is up in the image.",
            "matrix": (
                "Camera to world, with OpenGL axes: the columns are right, up, backward and origin."
            ),
            "resolution": "Width and height in pixels; left out where the view has an image.",
        },
    ),
    (
        "distortion: {type: opencv}",
        schema.OpencvSection,
        "A lens as OpenCV and COLMAP calibrate it, with nerfstudio's k4.\n"
        "Everything else that is said of the camera holds for the pinhole that would be left.",
        dict.fromkeys(("k1", "k2", "k3", "k4"), "Radial: of r^2, r^4, r^6 and r^8 in turn.")
        | dict.fromkeys(("p1", "p2"), "Tangential."),
    ),
    (
        "distortion: {type: fisheye}",
        schema.FisheyeSection,
        "A fisheye as OpenCV and COLMAP calibrate it.",
        dict.fromkeys(("k1", "k2", "k3", "k4"), "Of the angle's powers 3, 5, 7 and 9 in turn."),
    ),
    (
        "camera: {type: orthographic}",
        schema.OrthographicSection,
        "Parallel rays, as a satellite far away sees.\n"
        "Its other keys, `pixel_aspect` among them, are those of a perspective camera.",
        {
            "width": "Of the image [u].",
        },
    ),
    (
        "frames",
        schema.FramesSection,
        "A [film](films.md): pictures and masks are films, or have the number of a frame in "
        "their names, `front_{frame:04d}.png`.\n"
        "Other commands than `optimize` take its first frame.",
        {
            "first": "Number of the first frame.",
            "last": "Number of the last frame.",
            "step": "From one frame to the next.",
            "calibrate": (
                "Frames, spread along the film, that find together what does not change: all but "
                "fields. 0: each finds its own."
            ),
        },
    ),
    (
        "render",
        settings.RenderSettings,
        "How view rays are sampled.",
        {
            "samples_per_pixel": "Rays a pixel, over its area; one goes through its center.",
            "steps_per_voxel": (
                "Samples a cell along a ray. Left out: 2 where a cell is thicker than 0.75 optical"
                " depths in the scene as its file has it, else 1."
            ),
            "tolerance": (
                "Pixels finer than half a cell are interpolated between rays, but where they may"
                " change by more than this part of the image's root mean square. 0: every pixel "
                "has a ray of its own."
            ),
            "background": "Whether ambient light and environment maps are seen behind the volume.",
        },
    ),
    (
        "diffusion",
        settings.DiffusionSettings,
        "How light that is scattered more than once is found.\n"
        "[Settings](settings.md) says how to choose.",
        {
            "model": "`none` leaves such light out; `flux_limited` is the paper's for thin smoke.",
            "scheme": "`printed` is the paper's own discretization, for comparison.",
            "closure": "What the diffusion coefficient becomes in empty space.",
            "floor": "Of the smooth closure.",
            "tolerance": "Relative residual of a solve.",
            "warm_start": "Whether a solve begins at the last one's solution.",
            "transport_rounds": (
                "Sweeps along rays that take diffusion towards the transport equation. Left out, "
                "it is 1; 2 where g is above 0.55 in size, or optimized; 3 where it is above 0.77; "
                "0 without model `p1` or scheme `conservative`. Degree 5 adds one, or two in "
                "cells thicker than 4 optical depths. With lower degrees it is 1 in cells thicker "
                "than 3, and else at least 2 where the volume emits light; 4 within faces "
                "that reflect light (`volume.index`). Cells count as `refine` leaves them."
            ),
            "transport_tolerance": (
                "Rounds end where one changes light by less of it, at most `transport_rounds` of "
                "them, left out 16. `render.json` has how many there were, and their residual."
            ),
            "refine": (
                "Light is computed and seen in cells so many times as narrow; the medium is the "
                "same. Left out, it is 3 where a cell is thicker than 1.5 optical depths (0.75 "
                "where a face of the box is dense), or 9 where a third of it is, if there are no "
                "more than 1,048,576 cells then and density is not optimized; else 1."
            ),
            "refine_along": (
                "The axes along which cells are divided. Where `refine` is left out and all would "
                "be too many, those along which nothing varies and the box is eight times as long "
                "as along another are left out, up to 3,145,728 cells and colors."
            ),
            "degree": (
                "Degree to which such sweeps keep light's angles, along 44 directions, 86 for 7; "
                "of a single round 18 for 1, 26 for 3. Left out, it is 3, or 1 where g is not "
                "optimized and at most 0.32 in size. It is 5 where a face of the box is half as "
                "dense as the mean, or where g is below -0.67."
            ),
        },
    ),
    (
        "optimize",
        settings.OptimizeSettings,
        "What `ddrecon optimize` finds, and how.",
        {
            "parameters": "What to find: names, as in the last table, with their settings.",
            "iterations": (
                "In all. With `auto` a run ends by itself: "
                "[when to stop](settings.md#when-to-stop)."
            ),
            "loss": (
                "What is made small, as a mean over pixels. Unless given, `display` where pictures "
                "are sRGB files, `l2` where they are linear. [Settings](settings.md) says more."
            ),
            "noise": (
                "How pictures err, for `loss: photon`, which estimates it unless given, and for "
                "`ddrecon uncertainty`."
            ),
            "views_per_iteration": "Training views drawn at random for each iteration; 0 for all.",
            "derivatives": (
                "Which light passes derivatives on: all, only light scattered once, or only the "
                "diffusion's."
            ),
            "refine_at": (
                "Fractions of the run at which cells and pixels become half as large: coarse to "
                "fine."
            ),
            "begin_at": (
                "The fraction of the run that counts as made: what is left begins at its "
                "resolution and learning rates, as a frame of a film that begins with another does."
            ),
            "keep_start": (
                "The part of what fields began with that is mixed into them in the end: of a "
                "frame of a film, what is told by the frames before it."
            ),
            "final_rate": (
                "The part of their value to which learning rates fall over a run. 0.05 takes fewer "
                "iterations at full resolution where pictures agree well with each other."
            ),
        },
    ),
    (
        "optimize.noise, or noise of a view",
        settings.NoiseSettings,
        "In units of linear values, of which 1 is white in an sRGB file.",
        {
            "read": "Standard deviation of black.",
            "shot": "Variance by radiance, of the photons that are counted.",
        },
    ),
    (
        "optimize.parameters: {NAME: ...}",
        settings.ParameterSettings,
        "Settings of one parameter; all may be left out, `{}`.",
        {
            "init": "Where it starts; at the scene's own value unless given.",
            "lr": (
                "Learning rate, in the parameter's own unit; chosen by its size unless given."
                f" Of density it then has an optical depth of {DENSITY_STEP:g} across the box's"
                " shortest side. Numbers that are no field move by at most four times as much in"
                " an iteration."
            ),
            "min": "Its smallest value.",
            "max": "Its largest value.",
            "tv": (
                "Weight of its total variation, which smooths a field. 1 would weigh as much as "
                f"the whole brightness of the pictures. Unless given, {KINDS['density'].tv:g} for"
                " density and emission, of whose logarithm it is (E11.3), three times that for an"
                " emission that is the only field, and 0 for others."
            ),
            "field": (
                "Whether it differs from cell to cell; unless given, as its start does. Density "
                "always does."
            ),
            "support": (
                "For density: where it may be above 0. `masks`: nowhere that a view sees and its "
                "mask, or alpha, says is empty; `auto`: nor where it is as dark as it is away from "
                "smoke, within noise. Left out: anywhere."
            ),
            "support_margin": (
                "Pixels by which what a view shows is widened for that; 2 unless given. As many as "
                "the cameras may be off."
            ),
        },
    ),
]
"""Each section: its heading, its record, what it is, and what each key is, in words."""


def main() -> None:
    """Writes the pages."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each page, by the name of its file."""
    manual = ["# The scene file", INTRODUCTION, *_sections(is_expert=False), _parameters()]
    return {
        "scene_file.md": "\n\n".join(manual) + "\n",
        "expert_keys.md": "\n\n".join([EXPERT, *_sections(is_expert=True)]) + "\n",
        "scene.schema.json": json_schema(),
    }


def _sections(is_expert: bool) -> list[str]:
    """Each section, with a table of its keys that are for experts, or of the others."""
    found = []
    for heading, record, what, texts in SECTIONS:
        declared, hints = {field.name: field for field in fields(record)}, type_hints(record)
        rows = _joined(
            (name, f"{_takes(hints[name], declared[name])} | {_default(declared[name])} | {text}")
            for name, text in texts.items()
            if bool(declared[name].metadata.get("expert")) == is_expert
        )
        table = ["", "| key | takes | default | what |", "|---|---|---|---|", *rows] if rows else []
        if rows or not is_expert:
            lead = [] if is_expert else ["", what]
            found.append("\n".join([f"## {heading}", *lead, *table]))
    return found


def _joined(entries: Iterable[tuple[str, str]]) -> list[str]:
    """A row for each text; names that have the same stand together."""
    names: dict[str, list[str]] = {}
    for name, text in entries:
        names.setdefault(text, []).append(f"`{name}`")
    return [f"| {', '.join(each)} | {text} |" for text, each in names.items()]


def _takes(hint: Any, field: Field[Any]) -> str:
    """What a key takes, in words, with its limits."""
    limits = {key: value for key, value in field.metadata.items() if value is not None}
    if "choices" in limits:
        return ", ".join(f"`{choice}`" for choice in limits["choices"])
    words = {
        "minimum": "at least {:g}",
        "above": "above {:g}",
        "maximum": "at most {:g}",
        "below": "below {:g}",
    }
    within = [words[key].format(value) for key, value in limits.items() if key in words]
    return ", ".join([describe_type(hint), *within])


def _default(field: Field[Any]) -> str:
    """What stands where the key is left out."""
    if field.default is MISSING and field.default_factory is MISSING:
        return "required"
    value = field.default
    if value is None or value is MISSING:
        return ""
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{entry:g}' for entry in value)}]`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _parameters() -> str:
    """The table of what can be optimized."""
    entries = []
    for name, kind in KINDS.items():
        by_color, by_cell = ("yes" if holds else "" for holds in (kind.is_color, kind.is_cellwise))
        entries.append((name, f"{_limits(kind)} | {by_color} | {by_cell}"))
    rows = _joined(entries)
    return "\n".join(
        [
            "## Names of parameters",
            "",
            "What can be found.",
            "N is the place of a light in its list, counted from 0.",
            "NAME is a view's name, or `*` for all training views.",
            "Where there are two media, `media.cloud.density` is as `density` is, and so on.",
            "Colors have entries `.r`, `.g`, `.b`; places and directions have `.x`, `.y`, `.z`.",
            "A lens has its coefficients, `.k1` and so on.",
            "A `camera` has `.rotation_x` ... and `.x` ...: a rotation about the middle of the box"
            " [radians], then a shift [u], both in its axes (right, up, backward).",
            "A `focal` length is in widths of the image.",
            "`render --gradient` and `gradcheck --parameter` take the same names.",
            "",
            "| name | kept within | by color | from cell to cell |",
            "|---|---|---|---|",
            *rows,
        ]
    )


def _limits(kind: Kind) -> str:
    """What values of a `kind` are kept within, in words."""
    if kind.low == -math.inf:
        return ""
    return f"{kind.low:g} to {kind.high:g}" if kind.high < math.inf else f"at least {kind.low:g}"


NUMBERS = {
    "minimum": "minimum",
    "above": "exclusiveMinimum",
    "maximum": "maximum",
    "below": "exclusiveMaximum",
}
PLAIN = {NoneType: "null", bool: "boolean", int: "integer", float: "number", str: "string"}


def json_schema() -> str:
    """The scene file as a JSON schema, which editors know; a line for each record."""
    defined: dict[str, Any] = {}
    _define(schema.SceneTree, defined)
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in defined.items()]
    head = '"$schema": "https://json-schema.org/draft/2020-12/schema", "$ref": "#/$defs/SceneTree"'
    return f'{{{head}, "$defs": {{\n' + ",\n".join(lines) + "\n}}\n"


def _define(record: type, defined: dict[str, Any]) -> None:
    """Puts `record`, and all that it refers to, into `defined`."""
    if record.__name__ in defined:
        return
    texts = {
        key: text for _, kind, _, texts in SECTIONS if kind is record for key, text in texts.items()
    }
    tag = {"type": {"const": record.type}} if hasattr(record, "type") else {}
    entry: dict[str, Any] = {"type": "object", "additionalProperties": False, "properties": tag}
    defined[record.__name__] = entry
    entry["required"] = [*tag]
    for field in fields(record):
        hints = [*alternatives(type_hints(record)[field.name]), *field.metadata.get("also", ())]
        about = {"description": texts[field.name]} if field.name in texts else {}
        entry["properties"][field.name] = about | _any_of(hints, field.metadata, defined)
        if field.default is MISSING and field.default_factory is MISSING:
            entry["required"].append(field.name)


def _any_of(hints: Any, limits: Mapping[str, Any], defined: dict[str, Any]) -> dict[str, Any]:
    each = [_one(hint, limits, defined) for hint in hints]
    if settings.FieldFile in hints and float in hints:
        number = _one(float, limits, defined)
        each.append(
            {"type": "object", "properties": {"constant": number}, "required": ["constant"]}
        )
    return each[0] if len(each) == 1 else {"anyOf": each}


def _one(hint: Any, limits: Mapping[str, Any], defined: dict[str, Any]) -> dict[str, Any]:
    arguments = get_args(hint)
    if is_dataclass(hint):
        _define(hint, defined)  # type: ignore[arg-type]
        return {"$ref": f"#/$defs/{hint.__name__}"}  # type: ignore[union-attr]
    if get_origin(hint) is Literal:
        return {"enum": list(arguments)}
    if get_origin(hint) is tuple:
        size = {} if arguments[-1] is Ellipsis else {"minItems": len(arguments)}
        size |= {"maxItems": size["minItems"]} if size else {}
        return {
            "type": "array",
            "items": _any_of(alternatives(arguments[0]), limits, defined),
        } | size
    if get_origin(hint) is Mapping:
        return {"type": "object", "additionalProperties": _any_of([arguments[1]], {}, defined)}
    if hint in (int, str) and "choices" in limits:
        return {"enum": list(limits["choices"])}
    kind = {"type": PLAIN.get(hint, "string")}
    within = {
        NUMBERS[key]: value for key, value in limits.items() if key in NUMBERS and value is not None
    }
    return kind | within if hint in (int, float) else kind


if __name__ == "__main__":
    main()
