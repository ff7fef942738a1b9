"""Fit of the lattice of markers to the discs of an undeformed tip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.markers.detection import Discs, lattice, ring_numbers
from touchcell.perception.markers.matching import pair


def fit_lattice(discs: Discs, rings: int) -> tuple[Array, float]:
    """Fit the lattice to the discs of an undeformed, or hardly deformed, tip.

    A similarity with a scale that is a polynomial of the ring number, for the dome and the lens. The lattice is
    symmetric under rotation by 60 degrees; which of the six directions is the first makes no difference.

    Args:
        discs: of one image.
        rings: of the lattice.

    Returns:
        (m, 2) px marker positions, and the root mean square px of the discs from them; infinite when nothing fits.
    """
    centres = discs.centres
    flat = lattice(rings)
    if len(centres) < len(flat) // 2:
        return flat, np.inf
    radius = ring_numbers(rings) / rings
    z = (flat[:, 0] + 1j * flat[:, 1]) / rings
    terms = np.column_stack([np.ones(len(z)), z, z * radius**2, z * radius**4])
    centre = np.median(centres, axis=0)
    reach = np.percentile(np.linalg.norm(centres - centre, axis=1), 85) / np.percentile(np.abs(z), 85)
    seen_at = centres[:, 0] + 1j * centres[:, 1]
    best: tuple[float, Array, float] = (-np.inf, flat, np.inf)
    for turn in np.arange(12) * np.pi / 36:
        placed = complex(*centre) + reach * np.exp(1j * turn) * z
        for used, within, steps in ((2, 0.8, 6), (4, 0.4, 10)):
            before: tuple[NDArray[np.bool_], NDArray[np.intp]] | None = None
            for _ in range(steps):
                points = np.column_stack([placed.real, placed.imag])
                partner, paired = pair(points, centres, within * reach / rings)
                seen = partner[paired]
                # The same pairs again have the same solution.
                same = before is not None and np.array_equal(paired, before[0]) and np.array_equal(seen, before[1])
                if same or paired.sum() < 2 * used:
                    break
                before = paired, seen
                solution = np.linalg.lstsq(terms[paired, :used], seen_at[seen], rcond=None)[0]
                placed = terms[:, :used] @ solution
        points = np.column_stack([placed.real, placed.imag])
        partner, paired = pair(points, centres, 0.4 * reach / rings)
        if paired.any():
            rms = float(np.sqrt((np.abs(placed - seen_at[partner])[paired] ** 2).mean()))
            quality = paired.mean() - rms * rings / reach
            if quality > best[0]:
                best = (quality, points, rms if paired.mean() > 0.9 else np.inf)
    return best[1], best[2]
