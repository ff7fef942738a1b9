"""Meshes of the experiments with shapes: ``python -m touchcell.cell.experiments.sample_meshes FOLDER`` makes them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from touchcell.geometry.types import Array

SIDE_MM: Final = 110.0
CELLS: Final = 32
BOTTOM_MM: Final = -25.0

_RIDGE: Final = np.tan(np.radians(18.0))

HEIGHTS_MM: Final[dict[str, Callable[[Array, Array], Array]]] = {
    "saddle": lambda x, y: x**2 / 240.0 - y**2 / 180.0,
    "bowl": lambda x, y: 90.0 - np.sqrt(90.0**2 - x**2 - y**2),
    "wave": lambda x, y: 4.0 * np.cos(x / 11.0) * np.cos(y / 11.0),
    "hill": lambda x, y: 10.0 * np.exp(-(x**2 + y**2) / 1250.0),
    "step": lambda x, y: 5.0 * np.tanh(x / 14.0) + 0.0 * y,
    "ridge": lambda x, y: -_RIDGE * np.abs(x) + 0.0 * y,
    "trough": lambda x, y: _RIDGE * np.abs(x) - y**2 / 400.0,
}
"""Height of each over the plane, mm: both signs of curvature, a convex and a hollow crease."""

FILES: Final = {name: f"{name}.{suffix}" for name, suffix in zip(HEIGHTS_MM, 3 * ("stl", "obj", "ply"), strict=False)}


def block(height: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """Return vertices (n, 3) in mm and faces (m, 3) of a block with ``height`` as its top."""
    side = np.linspace(-0.5 * SIDE_MM, 0.5 * SIDE_MM, CELLS + 1)
    x, y = np.meshgrid(side, side)
    count = CELLS + 1
    top = np.stack([x, y, height(x, y)], axis=2).reshape(-1, 3)
    i = (np.arange(CELLS)[:, None] * count + np.arange(CELLS)).ravel()
    faces = [np.stack([i, i + 1, i + count + 1], 1), np.stack([i, i + count + 1, i + count], 1)]
    # The border counter-clockwise, and its image in the bottom.
    border = np.concatenate(
        [
            np.arange(count - 1),
            np.arange(count - 1) * count + count - 1,
            count * count - 1 - np.arange(count - 1),
            (count - 1 - np.arange(count - 1)) * count,
        ]
    )
    below = len(top) + np.arange(len(border))
    after, below_after = np.roll(border, -1), np.roll(below, -1)
    middle = np.full(len(border), len(top) + len(border))
    faces += [
        np.stack([border, below, below_after], 1),
        np.stack([border, below_after, after], 1),
        np.stack([middle, below_after, below], 1),
    ]
    floor = np.column_stack([top[border, :2], np.full(len(border), BOTTOM_MM)])
    return np.concatenate([top, floor, [[0.0, 0.0, BOTTOM_MM]]]), np.concatenate(faces)


def write(folder: Path) -> list[Path]:
    """Write all meshes into ``folder``; return them."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, height in HEIGHTS_MM.items():
        vertices, faces = block(height)
        mesh = trimesh.Trimesh(np.round(vertices, 4), faces, process=False)
        path = folder / FILES[name]
        path.write_bytes(data if isinstance(data := mesh.export(file_type=path.suffix[1:]), bytes) else data.encode())
        written.append(path)
    return written


if __name__ == "__main__":
    for path in write(Path(sys.argv[1])):
        print(path)
