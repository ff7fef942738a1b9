"""Entry points of contact features (group ``touchcell.features``): what a contact pose is relative to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class FeatureSpec:
    """Entry point of one kind of feature.

    Its estimators report ``T_s_f`` of a frame on the feature. Along some components that frame follows the sensor, so
    they are not measured; the others are the manifold on which its filters work (``FilterSpec.feature``).

    Attributes:
        name: as estimators and tasks name it.
        summary: one line for ``touchcell list``.
        measured: which of x, y, z, alpha, beta, gamma of ``T_f_s`` an estimator measures.
        decoupled: error map of the controller: position and orientation have errors of their own, for features whose
            frame may turn far at once, in place of the logarithm of the error on SE(3); see ``TactileServo``.
    """

    name: str
    summary: str
    measured: tuple[bool, bool, bool, bool, bool, bool] = (True, True, True, True, True, True)
    decoupled: bool = False


FEATURES: Final = Registry("touchcell.features", "contact feature", FeatureSpec)
"""All installed kinds of feature."""

SURFACE: Final = FeatureSpec("surface", "a surface: depth, tilt, shear and torsion")
EDGE: Final = FeatureSpec(
    "edge",
    "an edge: depth and tilt against the face beside it, distance across it, turn; {e} glides along it with the tip",
    measured=(True, False, True, True, True, True),
    decoupled=True,
)
