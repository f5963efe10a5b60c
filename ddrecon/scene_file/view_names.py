"""Names of views after their pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path


def name_views(images: Sequence[Path | None]) -> list[str]:
    """A name for each view, all different, by its image where it has one."""
    paths = [image or Path(f"view_{index:02d}") for index, image in enumerate(images)]
    stems = [re.sub(r"[^A-Za-z0-9_-]", "_", path.stem) for path in paths]
    longer = [
        f"{re.sub(r'[^A-Za-z0-9_-]', '_', path.parent.name)}_{stem}"
        for path, stem in zip(paths, stems, strict=True)
    ]
    numbered = [f"{index:03d}_{stem}" for index, stem in enumerate(stems)]
    return next(names for names in (stems, longer, numbered) if len(set(names)) == len(names))
