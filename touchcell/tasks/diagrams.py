"""State diagrams of the tasks: ``python -m touchcell.tasks.diagrams [FILE]`` redraws docs/explanation/tasks.md."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from touchcell.tasks.data_collection import DataCollectionConfig, collect_table
from touchcell.tasks.jog import JogConfig, jog_table
from touchcell.tasks.observe import ObserveConfig, observe_table
from touchcell.tasks.servoing import servo_table
from touchcell.tasks.state_machine import Table, mermaid
from touchcell.tasks.surface_following import SurfaceFollowingConfig

PAGE: Final = Path(__file__).parents[2] / "docs" / "explanation" / "tasks.md"

_BLOCK: Final = re.compile(r"(<!-- diagram: (\w+) -->\n).*?(<!-- end of diagram -->)", re.DOTALL)


def tables() -> Mapping[str, Table]:
    """Return the tables that are drawn, by the name in their markers."""
    return {
        "servoing": servo_table(
            "servoing", SurfaceFollowingConfig(), run_timeout_s=1.0, sidesteps=True, needs_feature=True
        ),
        "data_collection": collect_table(DataCollectionConfig()),
        "observe": observe_table(ObserveConfig()),
        "jog": jog_table(JogConfig()),
    }


def redraw(page: str, known: Mapping[str, Table]) -> str:
    """Return ``page`` with every diagram between its markers drawn from ``known``.

    Raises:
        KeyError: a diagram's name is not in ``known``.
    """

    def draw(block: re.Match[str]) -> str:
        return f"{block[1]}```mermaid\n{mermaid(known[block[2]])}\n```\n{block[3]}"

    return _BLOCK.sub(draw, page)


def redrawn(page: str) -> str:
    """Return ``page`` with every diagram between its markers drawn from the tasks.

    Raises:
        KeyError: a marker names an unknown diagram.
    """
    return redraw(page, tables())


def main(arguments: Sequence[str]) -> None:
    """Redraw the diagrams of the given page, or of ``docs/explanation/tasks.md``."""
    page = Path(arguments[0]) if arguments else PAGE
    page.write_text(redrawn(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
