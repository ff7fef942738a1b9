"""Whether an arm is the one that its chain file describes."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.errors import DeviceFault, FaultClass, Remedy
from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.geometry import se3
from touchcell.geometry.types import Array


def require_same_arm(device: str, chain: SerialChain, q: Array, T_base_tcp: Array) -> None:
    """Hold a chain against what a controller says of its own arm.

    Args:
        device: name for the error.
        chain: how we describe it.
        q: (n,) rad, told together with ...
        T_base_tcp: ... this pose (4, 4).

    Raises:
        DeviceFault: the poses lie further apart than two arms of one model.
    """
    apart = se3.compose(se3.inverse(chain.forward(q)), T_base_tcp)
    away_m, turned_rad = float(np.linalg.norm(apart[:3, 3])), float(np.linalg.norm(se3.log(apart)[3:]))
    if away_m > _SAME_ARM_M or turned_rad > _SAME_ARM_RAD:
        raise DeviceFault(
            device,
            f"its tool is {1e3 * away_m:.0f} mm and {np.rad2deg(turned_rad):.1f} deg from where the chain puts it",
            fault_class=FaultClass.CONFIGURATION,
            needs=Remedy.OPERATOR,
            hint="name the chain of this arm's model, and the tool that it carries",
        )


_SAME_ARM_M = 0.02
_SAME_ARM_RAD = np.deg2rad(2.0)
