"""What was found in version 0.1.0 and is fixed stays fixed: a part of ``python -m benchmarks findings``."""

from __future__ import annotations

import pytest

from tests.fault_injection.findings import ROWS, reproduced

FIXED = (
    *("S4", "S5", "S6b", "S7", "R1", "R4", "R6", "R7", "R8", "R8b", "R8c", "R8d", "R8e", "R8f"),
    *("a3", "a4", "a5", "a8", "a9", "a12", "a13"),
)


def test_each_finding_has_a_row() -> None:
    names = [f"S{k}" for k in range(1, 8)] + [f"R{k}" for k in range(1, 9)] + [f"a{k}" for k in range(1, 14)]
    assert [row.name for row in ROWS if row.name in names] == names
    parts = [row.name for row in ROWS if row.name not in names]
    assert {name[:-1] for name in parts} <= set(names)
    assert len(set(parts)) == len(parts)


@pytest.mark.parametrize("name", FIXED)
def test_it_stays_fixed(name: str) -> None:
    (row,) = (row for row in ROWS if row.name == name)
    verdict, text = reproduced(row)
    assert verdict == "fixed", text
