"""Some cases of a table in every run of the suite, all of them where they are asked for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def sampled(cases: Iterable[Any], count: int) -> list[Any]:
    """Return all cases for ``pytest.mark.parametrize``; `count` of them, evenly spread, run with `make test`.

    The others are marked ``exhaustive``: `make exhaustive` runs them too.
    """
    listed = list(cases)
    chosen = {index * len(listed) // count for index in range(count)}
    return [
        case if index in chosen else pytest.param(*_values(case), marks=pytest.mark.exhaustive)
        for index, case in enumerate(listed)
    ]


def _values(case: Any) -> tuple[Any, ...]:
    return case if isinstance(case, tuple) else (case,)
