from touchcell.geometry.types import ArrayLike

def median_5(image: ArrayLike, to: ArrayLike, /) -> None: ...
def threshold(image: ArrayLike, with_median: bool, block_px: int, offset: float, to: ArrayLike, /) -> None: ...
def shrink(image: ArrayLike, factor: int, to: ArrayLike, /) -> None: ...
def area_means(image: ArrayLike, to: ArrayLike, /) -> None: ...
def discs(image: ArrayLike, smallest_px: int, largest_px: int, longest_side_px: int, /) -> bytearray: ...
def pair(places: ArrayLike, points: ArrayLike, partner: ArrayLike, square: ArrayLike, owns: ArrayLike, /) -> None: ...
def grow(
    basis: ArrayLike,
    rough: ArrayLike,
    base: ArrayLike,
    coefficients: ArrayLike,
    start: ArrayLike,
    ridge: ArrayLike,
    points: ArrayLike,
    neighbours: ArrayLike,
    reach_px: float,
    onward: float,
    turns: int,
    change: ArrayLike,
    /,
) -> None: ...
def settle(
    basis: ArrayLike,
    rough: ArrayLike,
    base: ArrayLike,
    start: ArrayLike,
    ridge: ArrayLike,
    points: ArrayLike,
    reach_px: float,
    least_reach_px: float,
    settled_px: float,
    turns: int,
    coefficients: ArrayLike,
    /,
) -> None: ...
def squares_apart(
    basis: ArrayLike,
    rough: ArrayLike,
    base: ArrayLike,
    coefficients: ArrayLike,
    points: ArrayLike,
    step: int,
    squares: ArrayLike,
    /,
) -> None: ...
def find_markers(
    basis: ArrayLike,
    rough: ArrayLike,
    base: ArrayLike,
    coefficients: ArrayLike,
    points: ArrayLike,
    view: ArrayLike,
    positions: ArrayLike,
    seen: ArrayLike,
    /,
) -> tuple[int, int, int, float]: ...
def density(centres: ArrayLike, weights: ArrayLike, low: ArrayLike, cell_px: float, density: ArrayLike, /) -> None: ...
def bytes_apart(rows: ArrayLike, one: ArrayLike, apart: ArrayLike, /) -> None: ...
def affine(weight: ArrayLike, bias: ArrayLike, x: ArrayLike, to: ArrayLike, /) -> None: ...
def reads_halves() -> bool: ...
def affine_of_halves(weight: ArrayLike, bias: ArrayLike, x: ArrayLike, to: ArrayLike, /) -> None: ...
def mean_shift(image: ArrayLike, radius_px: float, turns: int, places: ArrayLike, levels: ArrayLike, /) -> None: ...
def follow(
    image: ArrayLike,
    terms: ArrayLike,
    weight: ArrayLike,
    rest: ArrayLike,
    field: ArrayLike,
    neighbours: ArrayLike,
    limits: ArrayLike,
    expected: ArrayLike,
    off: ArrayLike,
    around: ArrayLike,
    seen: ArrayLike,
    /,
) -> float: ...
def measure_field(
    off: ArrayLike,
    mean: ArrayLike,
    rows: ArrayLike,
    sd: ArrayLike,
    strongest: int,
    measured: ArrayLike,
    /,
) -> None: ...
def block_changes(one: ArrayLike, other: ArrayLike, means: ArrayLike, /) -> None: ...
def first_block(image: ArrayLike, weight: ArrayLike, bias: ArrayLike, to: ArrayLike, /) -> None: ...
