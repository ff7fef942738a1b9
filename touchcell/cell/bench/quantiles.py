"""Median and 99th percentile for benchmark tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from touchcell.geometry.types import Array


def median_and_p99(values: Sequence[float] | Array, unit: float = 1.0) -> dict[str, float]:
    """Return ``median`` and ``p99`` of some values, times ``unit``."""
    return {"median": unit * float(np.median(values)), "p99": unit * float(np.percentile(values, 99))}
