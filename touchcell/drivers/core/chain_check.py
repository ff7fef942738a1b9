"""Check that the connected arm matches its chain description."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.errors import DeviceFault, FaultClass, Remedy
from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.geometry import se3
from touchcell.geometry.types import Array


def require_same_arm(device: str, chain: SerialChain, q: Array, T_base_tcp: Array) -> None:
    """Compare the forward kinematics of a chain with the pose that the controller reports.

    Args:
        device: device name for the error.
        chain: configured kinematic chain.
        q: (n,) rad, reported by the controller together with ``T_base_tcp``.
        T_base_tcp: (4, 4) tool pose reported by the controller.

    Raises:
        DeviceFault: the poses differ by more than manufacturing tolerances of one model.
    """
    apart = se3.compose(se3.inverse(chain.forward(q)), T_base_tcp)
    away_m, turned_rad = float(np.linalg.norm(apart[:3, 3])), float(np.linalg.norm(se3.log(apart)[3:]))
    if away_m > _SAME_ARM_M or turned_rad > _SAME_ARM_RAD:
        raise DeviceFault(
            device,
            f"tool pose is {1e3 * away_m:.0f} mm and {np.rad2deg(turned_rad):.1f} deg from the one its chain gives",
            fault_class=FaultClass.CONFIGURATION,
            needs=Remedy.OPERATOR,
            hint="set `chain` to this arm's model and `tool` to the mounted tool",
        )


_SAME_ARM_M = 0.02
_SAME_ARM_RAD = np.deg2rad(2.0)
