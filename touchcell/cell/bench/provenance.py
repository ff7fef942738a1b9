"""Where and when a benchmark was measured, and the environment in which it starts processes."""

from __future__ import annotations

import os
from pathlib import Path

from touchcell.cell.analysis.provenance import provenance

__all__ = ["as_installed", "provenance"]


def as_installed(folder: Path) -> dict[str, str]:
    """Environment of a process that finds its modules compiled, as an installed package's are, in ``folder``."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**inherited, "PYTHONPYCACHEPREFIX": str(folder / "bytecode")}
