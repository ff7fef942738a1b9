"""Finding a cell file by its path, or a shipped one by its name."""

from __future__ import annotations

import os
from pathlib import Path

from touchcell.paths import CONFIGS


def find_cell(path: Path) -> Path:
    """``path`` itself, or the cell file of that name that ships with touchcell."""
    shipped = CONFIGS / path.name
    return path if os.path.exists(path) or not os.path.exists(shipped) else shipped
