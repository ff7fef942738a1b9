"""How sensors of one kind differ: tips between the default one and one that was fitted to a real sensor's images.

Both show the same lattice of markers at rest, and deform otherwise: what a model that knows one of them reads of the
other is 0.5 mm off at a depth of 3 mm (docs/decisions/0103-trained-over-tips.md). One that has seen all between them
tells from the shape of a deformation which of them it may be.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Final

import numpy as np

from touchcell.simulation.tip import TipParameters
from touchcell.simulation.tip_file import load_tip

_OTHER: Final = "franka_tactip_1"
_SHARE: Final = (-0.15, 1.15)
"""Of the way from the default tip to the other one, and a little beyond both."""
_SHARE_SD: Final = 0.25
"""By which each parameter of the skin is elsewhere on that way than the camera."""
_CAMERA: Final = frozenset(
    {
        "ring_step_rad",
        "layout_phase_rad",
        "marker_radius_m",
        "camera_distance_m",
        "focal_px",
        "centre_px",
        "image_rotation_rad",
        "camera_tilt_rad",
    }
)
"""Together they make the lattice at rest, which all of these sensors share."""
_KEPT: Final = frozenset({"rings", "mirrored"})
_SIGNED: Final = frozenset({"rock", *_CAMERA})


class TipSpread:
    """Random tips of one kind."""

    def __init__(self) -> None:
        self._one, self._other = TipParameters(), load_tip(_OTHER).tip

    def draw(self, rng: np.random.Generator) -> TipParameters:
        """Return the parameters of a random sensor; scatter about them is not in it."""
        common = rng.uniform(*_SHARE)
        drawn: dict[str, object] = {}
        for each in fields(TipParameters):
            if each.name in _KEPT:
                continue
            share = common if each.name in _CAMERA else common + rng.normal(0.0, _SHARE_SD)
            one, other = np.asarray(getattr(self._one, each.name)), np.asarray(getattr(self._other, each.name))
            between = one + share * (other - one)
            if each.name not in _SIGNED:
                between = np.maximum(between, 0.0)
            drawn[each.name] = tuple(between.tolist()) if between.ndim else float(between)
        return replace(self._one, **drawn)  # type: ignore[arg-type]
