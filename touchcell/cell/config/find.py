"""Finding a cell file by its path, or a shipped one by its name."""

from __future__ import annotations

import os
from pathlib import Path

from touchcell.paths import CONFIGS


def find_cell(path: Path) -> Path:
    """Return ``path`` itself, or the cell file of that name that ships with touchcell.

    The ending ``.yaml`` may be left out.
    """
    if os.path.exists(path) and not os.path.isdir(path):
        return path
    named = path if path.suffix else Path(f"{path}.yaml")
    return next((file for file in (named, CONFIGS / named.name) if os.path.exists(file)), path)
