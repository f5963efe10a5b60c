"""What is in a folder, without opening what is no file."""

import os
from pathlib import Path


def files_below(folder: Path) -> set[str]:
    """Every name below `folder`."""
    return {
        os.path.join(where, name)
        for where, folders, names in os.walk(folder)
        for name in (*folders, *names)
    }
