"""One page of HTML that needs nothing beside it, for all that is reported: `assets/page.html`.

Which sections it has is said by the facts that it is given; text is escaped by the template.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from ddrecon.io.files.atomic import write_bytes


def write_page(path: Path, **facts: Any) -> None:
    """Writes the page of these `facts` to `path`."""
    write_bytes(path, page_text(**facts).encode(errors="replace"))


def page_text(**facts: Any) -> str:
    """The page: its `title`, `lead`, a sentence, and the sections whose facts are there.

    While a job `goes_on`, browsers load its page again and again. A page that `is_small` is laid
    out for a frame within another page. What the other facts hold the template says.
    """
    from jinja2 import Environment, PackageLoader  # here, so that commands start at once

    loader = PackageLoader("ddrecon.report", "assets")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.filters["uri"] = embed
    return environment.get_template("page.html").render(facts)


def embed(image: bytes) -> str:
    """The address of the PNG or WebP `image`, which holds it."""
    kind = "png" if image.startswith(b"\x89PNG") else "webp"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"
