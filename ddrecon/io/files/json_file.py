"""JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ddrecon.io.files.atomic import replace_file


def write_json(path: Path, content: Any) -> None:
    """Writes `content` to `path`, indented."""
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
