"""Random contacts of randomised simulated sensors with edges: Algorithm 1 of the paper, generalised.

For each sample the tip is tilted, turned and offset against a straight edge of a block, pressed in and sheared. The
label is the pose of the sensor in the edge frame {e} (``touchcell.simulation.edges``); its y, along the edge, carries
nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.closed_forms import Box
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.relief import felt_relief
from touchcell.simulation.samples import SampledContact, Variation, scattered
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.tip import Tip, TipParameters

_IMAGES_PER_TIP: Final = 16
_BLOCK_M: Final = (0.4, 0.4, 0.1)
_T_WORLD_E: Final = se3.from_euler_mm_deg(np.array([200.0, 0.0, 120.0, 180.0, 0.0, 0.0]))
"""Of the edge at x = 200 mm of the block, for a tip of 20 mm."""


@dataclass(frozen=True, slots=True)
class EdgeRanges:
    """From where contacts are drawn, evenly.

    Attributes:
        offset_mm: of the tip across the edge, to either side.
        depth_mm: smallest and largest.
        tilt_deg: largest about either axis.
        turn_deg: largest about the normal.
        shear_mm: largest, in any direction.
    """

    offset_mm: float = 7.0
    depth_mm: tuple[float, float] = (0.5, 5.5)
    tilt_deg: float = 12.0
    turn_deg: float = 60.0
    shear_mm: float = 3.0


def edge_contacts(
    n: int, seed: int, *, ranges: EdgeRanges | None = None, variation: Variation | None = None
) -> Iterator[SampledContact]:
    """Yield ``n`` random contacts with edges, the same for the same seed."""
    rng = np.random.default_rng(seed)
    ranges, variation, law = ranges or EdgeRanges(), variation or Variation(), ContactLaw()
    surface = Surface(Box(_BLOCK_M))
    for start in range(0, n, _IMAGES_PER_TIP):
        tip = Tip(scattered(TipParameters(), variation, rng))
        for _ in range(min(_IMAGES_PER_TIP, n - start)):
            T_e_s = se3.from_euler_mm_deg(_drawn(ranges, rng))
            pixels = _pixels(tip, T_e_s, _shear(ranges, rng), surface, law)
            pixels = pixels + rng.normal(0.0, variation.marker_px, pixels.shape)
            seen = rng.random(len(pixels)) >= variation.missing
            radius = tip.parameters.disc_radius_px * (1.0 + rng.normal(0.0, variation.disc_radius))
            yield SampledContact(T_e_s, pixels[seen], float(radius))


def _drawn(ranges: EdgeRanges, rng: np.random.Generator) -> Array:
    low, high = ranges.depth_mm
    # Along the edge nothing is felt: a label within a tenth of a millimetre keeps its scale from being zero.
    offset, along, depth = rng.uniform([-ranges.offset_mm, -0.1, low], [ranges.offset_mm, 0.1, high])
    alpha, beta = rng.uniform(-ranges.tilt_deg, ranges.tilt_deg, 2)
    return np.array([offset, along, depth, alpha, beta, rng.uniform(-ranges.turn_deg, ranges.turn_deg)])


def _shear(ranges: EdgeRanges, rng: np.random.Generator) -> Array:
    angle, length = rng.uniform(0.0, 2.0 * np.pi), 1e-3 * ranges.shear_mm * np.sqrt(rng.random())
    return np.array([length * np.cos(angle), length * np.sin(angle), 0.0, 0.0, 0.0, 0.0])


def _pixels(tip: Tip, T_e_s: Array, shear: Array, surface: Surface, law: ContactLaw) -> Array:
    model = ContactModel(law)
    T_world_s = se3.compose(_T_WORLD_E, T_e_s)
    model.step(se3.compose(se3.compose(_T_WORLD_E, se3.exp(-shear)), T_e_s), surface, 0.0)
    state = model.step(T_world_s, surface, 0.0)
    relief = felt_relief(surface, T_world_s, 0.0, tip.relief.directions, law.tip_radius_m)
    return tip.pixels(state.T_f_s, relief)
