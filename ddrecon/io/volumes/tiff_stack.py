"""Volumes as float TIFF stacks, for Fiji and napari: a page a slice across z.

Row 0 is at the lowest y, and colors are three channels. Laid out as ImageJ's hyperstacks, written
through `tifffile`, read through OpenImageIO (extra `tiff`). A file holds one field, without a name.
Its box is in ImageJ's calibration, and in full precision in an entry `bounds` of its description.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.images.oiio import opened, read_pixels
from ddrecon.io.volumes.field import Field, Fields, check_field, require_only_field


def write_stack(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes the one of `fields`, [z, y, x] or [z, y, x, 3], as float32, and its box.

    `bounds` [2, 3] are the corners (x, y, z) [u]. The format knows no names.
    """
    tifffile = load_for_file("tifffile", path)
    values = as_float32(require_only_field(path, fields))
    size = (bounds[1] - bounds[0]) / values.shape[2::-1]
    origin = dict(zip(("xorigin", "yorigin", "zorigin"), (-bounds[0] / size).tolist(), strict=True))
    facts = {"axes": "TZCYXS", "spacing": float(size[2]), "unit": "u", **origin}
    pages = (values[:, None] if values.ndim == 3 else np.moveaxis(values, 3, 1))[None, ..., None]
    with replace_file(path) as temporary:
        tifffile.imwrite(
            temporary,
            pages,
            imagej=True,
            photometric="minisblack",
            resolution=tuple(1 / size[:2]),
            metadata={**facts, "bounds": json.dumps(bounds.tolist())},
        )


def read_stack(path: Path, name: str) -> Field:
    """The field at `path`, taken for `name`; raises FormatError if damaged or no legal field."""
    with opened(path, "TIFF") as (file, spec):
        description = spec.get_string_attribute("ImageDescription")
        pages = list[np.ndarray]()
        while file.seek_subimage(len(pages), 0):
            pages.append(read_pixels(path, file, "unknown"))
            check_size(4 * pages[0].size * len(pages), path, "the stack")
        # The end of the pages is an error, too: in OpenImageIO 3.0 the file's name alone.
        error = file.geterror()
        if error and "could not seek" not in error and error != f"Err: {path}":
            raise FormatError(path, f"is damaged: {error}")
        per_unit = [spec.get_float_attribute(f"{axis}Resolution", 1.0) for axis in "XY"]
    values = np.stack(pages)
    facts = _facts(path, description, values.shape[3])
    if len(pages) != int(facts.get("images", len(pages))):
        raise FormatError(path, f"is damaged: {len(pages)} of {facts['images']} pages are there")
    if int(facts.get("frames", 1)) > 1:
        raise FormatError(path, f"has {facts['frames']} frames; save a stack of one")
    if (channels := int(facts.get("channels", 1))) > 1:
        values = np.stack([values[index::channels, ..., 0] for index in range(channels)], -1)
    bounds = None
    if "bounds" in facts:
        bounds = np.array(json.loads(facts["bounds"]), np.float64)
    elif "spacing" in facts:
        sides = facts.get("width", 1 / per_unit[0]), facts.get("height", 1 / per_unit[1])
        size = np.array([*sides, facts["spacing"]], np.float64)
        low = 0.0 - size * [float(facts.get(f"{axis}origin", 0)) for axis in "xyz"]
        bounds = np.stack([low, low + size * values.shape[2::-1]])
    return check_field(path, name, values, bounds)


def _facts(path: Path, description: str, samples: int) -> dict[str, str]:
    """What the `description` of a stack, a page of which has so many `samples`, says of it.

    It is in ImageJ's words, into which OME's are put. Raises FormatError for OME's and tifffile's
    stacks of several channels, times or images, and for sizes of voxels in different units.
    """
    facts = dict(line.split("=", 1) for line in description.splitlines() if "=" in line)
    units = {facts[name] for name in ("unit", "yunit", "zunit") if name in facts}
    several = ""
    if re.search(r"<(\w+:)?OME\b", description):
        images = re.findall(r"<(?:\w+:)?Pixels\b[^>]*>", description)
        attributes = dict(re.findall(r'(\w+)="([^"]*)"', "".join(images)))
        slices, channels, times = (int(attributes.get(f"Size{axis}", 1)) for axis in "ZCT")
        if len(images) != 1 or channels != samples or times > 1:
            several = f"{len(images)} images of {channels} channels and {times} frames"
        facts, units = {"images": str(slices)}, set()
        if all(f"PhysicalSize{axis}" in attributes for axis in "XYZ"):
            units = {attributes.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"}
            words = zip(("width", "height", "spacing"), "XYZ", strict=True)
            facts |= {word: attributes[f"PhysicalSize{axis}"] for word, axis in words}
    elif description.startswith('{"shape":'):
        shape = json.loads(description)["shape"]
        if sum(count > 1 for count in shape[: -2 - (samples > 1)]) > 1:
            several = f"the shape {shape}"
    if several:
        raise FormatError(path, f"has {several}; save a stack of one, [z, y, x]")
    if len(units) > 1:
        raise FormatError(path, f"has sizes of voxels in {' and '.join(sorted(units))}; take one")
    return facts
