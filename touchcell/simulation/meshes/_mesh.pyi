import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array

class Tree:
    def __new__(
        cls,
        vertices: Array,
        faces: NDArray[np.int32],
        corner_normals: Array,
        corner_bends: Array,
        neighbours: NDArray[np.int32],
        edge_normals: Array,
        vertex_normals: Array,
        /,
    ) -> Tree: ...
    def nearest(self, x: float, y: float, z: float, /) -> tuple[float, ...]: ...
    def distances(self, points: Array, /) -> Array: ...
