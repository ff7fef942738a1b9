import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray

def paint(image: ImageArray, centres: Array, stamps: ImageArray, /) -> None: ...
def expose(
    cover: ImageArray,
    contrast: ImageArray,
    background: ImageArray,
    noise: NDArray[np.int8],
    top: int,
    left: int,
    /,
) -> ImageArray: ...
