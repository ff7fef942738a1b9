"""``touchcell new hil CELL``: a test module for a cell, from what the cell file says and from one simulated run."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Final

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import plan_in_world
from touchcell.errors import ConfigError

_TEMPLATES: Final = Path(__file__).parent / "templates"
_LONGEST_S: Final = 120.0
_REST: Final = "    hil_cell.assert_nothing_sent_since_trip()\n    hil_cell.assert_stopped_as_declared()"


@dataclass(frozen=True)
class Visited:
    """A state of the task that a nominal run in simulation was in.

    Attributes:
        name: of the state.
        cycles: how many control cycles the run was in it.
    """

    name: str
    cycles: int


def new_hil(cell: Path, folder: Path) -> Path:
    """Write the test module of a cell and return its path.

    Args:
        cell: the cell file.
        folder: where to write it.

    Raises:
        ConfigError: the cell is not valid, cannot be simulated, or the module exists already.
    """
    plan = plan_in_world(cell, "sim", settings={"on_trip": "wait_for_reset"})
    module = folder / f"test_{re.sub(r'[^0-9a-z]+', '_', cell.stem.lower())}_hil.py"
    if module.exists():
        raise ConfigError(f"{module} is there already", key="--out", value=str(folder), hint="move it away")
    text = module_text(plan, os.path.relpath(cell.resolve(), folder.resolve()), visited_states(plan))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        module.write_text(text)
    except OSError as error:
        raise ConfigError(f"{module} cannot be written: {error.strerror}", hint="--out DIR") from None
    return module


def visited_states(plan: CellPlan) -> list[Visited]:
    """Return the working states of the task that a nominal run in simulation is in, in order."""
    from touchcell.testing.cell_under_test import CellUnderTest

    cycles: dict[str, int] = {}
    with CellUnderTest(plan) as running:
        working = set(getattr(running.cell.task, "states", ()))
        while running.t_s < _LONGEST_S and not running.waits_for_reset and not running.has_ended:
            state = running.state
            cycles[state] = cycles.get(state, 0) + 1
            running.step()
    return [Visited(name, count) for name, count in cycles.items() if name in working and count > 1]


def module_text(plan: CellPlan, cell: str, visited: list[Visited]) -> str:
    """Return the text of the module.

    Args:
        plan: of the cell in simulation.
        cell: the cell file, relative to the module.
        visited: see ``visited_states``.
    """
    moved = bool(plan.arms)
    parts = [_template("head", cell=cell, name=plan.cell.name, task=plan.task.name, table=_table(plan))]
    parts += [_interlock_test(plan, name, visited, moved=moved) for name in _provable(plan)]
    parts += [_template("state", state=state.name, name=_word(state.name)) for state in visited if moved]
    parts += [_template("device", device=name, title=name.title().replace("_", "")) for name in plan.devices]
    return "\n\n\n".join(part.strip("\n") for part in parts) + "\n"


def _provable(plan: CellPlan) -> Iterator[str]:
    for name in plan.cell.interlocks:
        if any(proof.interlock == name and proof.tripped_s is not None for proof in plan.proofs):
            yield name


def _table(plan: CellPlan) -> str:
    """Return the settings of the interlocks as a Python dictionary, one to a line."""
    rows = []
    for name in _provable(plan):
        entry = plan.cell.interlocks[name]
        settings = entry.model_dump(mode="json", exclude_defaults=True)
        settings |= {"kind": entry.kind, "severity": entry.severity}
        rows.append(f"    {json.dumps(name)}: {json.dumps(settings, ensure_ascii=False)},\n")
    return f"{{\n{''.join(rows)}}}"


def _interlock_test(plan: CellPlan, name: str, visited: list[Visited], *, moved: bool) -> str:
    proofs = [proof for proof in plan.proofs if proof.interlock == name and proof.tripped_s is not None]
    shown = proofs[0]
    states = [state for state in visited if not shown.states or state.name in shown.states]
    longest = max(states, key=lambda state: state.cycles, default=None)
    after_s = max(proof.tripped_s for proof in proofs if proof.tripped_s is not None)
    return _template(
        "interlock",
        interlock=name,
        name=_word(name),
        what=f"{shown.fault}{f' ({shown.limit})' if shown.limit else ''}",
        after_s=f"{after_s:.3f}",
        reach="hil_cell.step(2)" if longest is None else f'hil_cell.run_until("{longest.name}")',
        rest=_REST if moved else "",
    )


def _word(name: str) -> str:
    return re.sub(r"\W+", "_", name.lower())


def _template(template: str, /, **words: str) -> str:
    text = Template((_TEMPLATES / f"hil_{template}.py.txt").read_text()).substitute(words)
    return text.rstrip() + "\n"
