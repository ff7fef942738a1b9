"""Binary STL of a part of a scene, which the page's three-dimensional view loads."""

from __future__ import annotations

import struct
from typing import Final

import numpy as np

from touchcell.geometry.solids import Mesh

_FACET: Final = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def stl(mesh: Mesh) -> bytes:
    """Return the triangles of a mesh in metres; facets' normals are zero, and derived by the reader."""
    facets = np.zeros(len(mesh.triangles), dtype=_FACET)
    facets["corners"] = mesh.vertices_m[mesh.triangles]
    return b"touchcell".ljust(80, b" ") + struct.pack("<I", len(facets)) + facets.tobytes()
