"""The ``sweep:`` section of a cell file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError

from touchcell.cell.config.layers import load_layers
from touchcell.errors import ConfigError


class SweepSection(BaseModel):
    """What ``touchcell sweep`` changes; options of the command line add to it and replace it.

    Attributes:
        grid: for each key of the cell, a list of values, ``FIRST:LAST:COUNT`` or ``FIRST..LAST``; all combinations run.
        sample: for each key of the cell, a distribution or ``FIRST..LAST``.
        samples: draws at each point of the grid.
        seed: of the draws.
        measures: names of the numbers to show, with ``*``.
        time_limit_s: longest time for one trial.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    grid: dict[str, Any] = {}
    sample: dict[str, Any] = {}
    samples: PositiveInt | None = None
    seed: int = Field(0, ge=0)
    measures: tuple[str, ...] = ()
    time_limit_s: PositiveFloat | None = None


def read_section(path: Path) -> SweepSection:
    """Return the section of a cell file; an empty one if it has none.

    Raises:
        ConfigError: the file or the section is invalid.
    """
    file = load_layers(path)
    section = file.data.get("sweep") or {}
    if not isinstance(section, Mapping):
        raise file.problem(("sweep",), "is no section", value=section, hint="e.g. `sweep: {grid: {seed: 1..5}}`")
    try:
        return SweepSection.model_validate(dict(section))
    except ValidationError as error:
        first = error.errors()[0]
        at = ("sweep", *first["loc"])
        raise file.problem(
            at, first["msg"], value=first.get("input"), hint=f"keys: {', '.join(SweepSection.model_fields)}"
        ) from None


def pairs(arguments: list[str], option: str) -> dict[str, str]:
    """Read ``KEY=VALUES`` arguments of an option.

    Raises:
        ConfigError: one has no "=", or an empty key.
    """
    found: dict[str, str] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not all(key.split(".")) or not value:
            raise ConfigError(
                "is not KEY=VALUES", file=option, value=argument, hint=f"e.g. {option} task.depth_mm=1:5:9"
            )
        found[key] = value
    return found
