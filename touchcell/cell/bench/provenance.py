"""Provenance of a benchmark's figures, and the environment of the processes that it starts."""

from __future__ import annotations

import os
from pathlib import Path

from touchcell.cell.analysis.provenance import provenance

__all__ = ["as_installed", "provenance"]


def as_installed(folder: Path) -> dict[str, str]:
    """Return an environment in which a process finds its modules byte-compiled in ``folder``, as if installed."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**inherited, "PYTHONPYCACHEPREFIX": str(folder / "bytecode")}
