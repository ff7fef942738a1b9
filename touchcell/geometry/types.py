"""Array types used throughout touchcell. Shapes are stated in each docstring."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Float64 array: a pose ``T_a_b`` is (4, 4), a twist or exponential coordinates ``[v, w]`` (6,)."""

ImageArray: TypeAlias = NDArray[np.uint8]
"""8-bit image, (height, width) grey or (height, width, 3) BGR."""

ArrayLike: TypeAlias = Any
