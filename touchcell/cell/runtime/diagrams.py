"""State diagram of the run loop in the documentation: ``python -m touchcell.cell.runtime.diagrams`` redraws it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from touchcell.cell.runtime.run_states import run_table
from touchcell.paths import CHECKOUT
from touchcell.tasks.diagrams import redraw

PAGE: Final[Path] = CHECKOUT / "docs" / "explanation" / "architecture.md"


def redrawn(page: str) -> str:
    """``page`` with its diagram drawn from the code. Raises KeyError for one that is not known."""
    return redraw(page, {"run": run_table(max_duration_s=1.0)})


if __name__ == "__main__":
    PAGE.write_text(redrawn(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
