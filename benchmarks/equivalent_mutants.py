"""Mutants that no test can notice, because what they change has no effect that anything outside can see.

Each is named by its module, the line of source that it changes and the change, with the reason. A line that is edited
loses its entries, so that a reason cannot outlive the code that it is about.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

SHORTCUT: Final = "a shortcut that gives what the rest would"
ROUNDING: Final = "differs only where two computed numbers are equal to the last bit, and gives the same there"

EQUIVALENT: Mapping[tuple[str, str, str], str] = {
    ("gate", "if linear <= max_linear and angular <= max_angular:", "if -> if False"): SHORTCUT,
    ("gate", "if linear <= max_linear and angular <= max_angular:", "LtE -> Lt"): SHORTCUT,
    ("gate", "_NEGLIGIBLE = 1e-12", "1e-12 -> 2e-12"): "a way of a picometre per second",
    ("gate", "if left > _NEGLIGIBLE:", "Gt -> GtE"): "a way of a picometre per second",
    ("gate", "if asked > jerk * _ROUNDING:", "Gt -> GtE"): ROUNDING,
    ("gate", "if size > limit * _ROUNDING:", "Gt -> GtE"): ROUNDING,
    (
        "gate",
        "asked = max(step, rate * left if smooth < rate else 0.0) / dt_s",
        "Lt -> LtE",
    ): "both are equal only where neither asks for more than the jerk",
}
"""Reason by module, line of source without its indentation, and change."""


def equivalent(module: str, source: str, line: int, what: str) -> str:
    """Return the reason why a mutant of ``source`` at ``line`` is equivalent; "" if it is not known to be."""
    return EQUIVALENT.get((module, source.splitlines()[line - 1].strip(), what), "")
