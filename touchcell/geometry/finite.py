"""Fast finiteness check for small arrays."""

from __future__ import annotations

import math

from touchcell.geometry.types import Array


def all_finite(array: Array) -> bool:
    """Return True if no number of ``array`` (any shape) is NaN or infinite.

    Takes half of NumPy's time for arrays of 6 or 16 numbers.
    """
    return all(map(math.isfinite, array.ravel().tolist()))
