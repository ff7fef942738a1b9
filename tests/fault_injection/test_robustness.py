"""The robustness experiment changes the same conditions for one arm and for two, and nothing else."""

from __future__ import annotations

from typing import Any

import pytest

from touchcell.cell.experiments.robustness import CHANGES, SPEC
from touchcell.cell.experiments.runner import Scale

CELLS = {trial.row: trial.cell_data() for trial in SPEC.trials(Scale(trials=1))}


def differences(left: Any, right: Any, key: str = "") -> set[str]:
    """Return dotted keys in which two cell files differ."""
    if isinstance(left, dict) and isinstance(right, dict):
        keys = left.keys() | right.keys()
        return {found for each in keys for found in differences(left.get(each), right.get(each), f"{key}.{each}")}
    return set() if left == right else {key[1:]}


@pytest.mark.parametrize("arms", ["one arm", "two arms"])
@pytest.mark.parametrize("what", [each for each in CHANGES if each != "as it is"])
def test_a_row_differs_from_the_unchanged_cell_in_its_named_condition_only(arms: str, what: str) -> None:
    as_it_is, changed = CELLS[f"as it is, {arms}"], CELLS[f"{what}, {arms}"]
    expected = {key.replace("*", sensor) for key in CHANGES[what] for sensor in as_it_is["sensors"]}
    assert differences(as_it_is, changed) == expected


def test_two_arms_have_the_rows_of_one() -> None:
    rows = [row.rpartition(", ")[::2] for row in CELLS]
    assert [what for what, arms in rows if arms == "one arm"] == [what for what, arms in rows if arms == "two arms"]
