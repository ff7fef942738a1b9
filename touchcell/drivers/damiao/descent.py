"""Lower an arm without brakes along gravity, slowly, until it rests. Pure arithmetic, no bus and no clock."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.geometry.types import Array

_SLOWEST_RAD_S = 0.3
_BLOCKED_RAD = np.deg2rad(3.0)
_NO_WEIGHT_N_M = 0.05


class Descent:
    """A joint setpoint that goes downhill in the potential energy of arm and tool.

    Each step follows the negative gradient, which is the vector of torques that gravity exerts on the joints, with the
    tool no faster than ``speed_m_s``. A joint at the end of its range does not move, nor does one that does not follow
    because something supports it, for as long as it does not.

    Args:
        chain: of the arm, with its masses and its tool.
        q: (n,) rad where it begins.
        speed_m_s: greatest speed of the tool centre point.

    Attributes:
        q: setpoint (n,) rad.
        rests: whether no joint could go down in the latest step.
    """

    def __init__(self, chain: SerialChain, q: Array, speed_m_s: float) -> None:
        self._chain = chain
        self._speed_m_s = speed_m_s
        self.q = np.clip(q, chain.lower, chain.upper)
        self.rests = False

    def step(self, measured: Array, dt_s: float) -> Array:
        """Advance by ``dt_s``; return the setpoint (n,) rad.

        Args:
            measured: (n,) rad joint angles now.
            dt_s: time since the last step.
        """
        chain = self._chain
        downhill = -chain.gravity_torques(self.q)
        # What lags behind a setpoint that goes down is held up by something. One that was only late catches up.
        lag = self.q - measured
        supported = (np.abs(lag) > _BLOCKED_RAD) & (np.sign(lag) == np.sign(downhill))
        at_end = ((self.q <= chain.lower) & (downhill < 0.0)) | ((self.q >= chain.upper) & (downhill > 0.0))
        downhill = np.where(supported | at_end, 0.0, downhill)
        weight = float(np.abs(downhill).max())
        self.rests = weight < _NO_WEIGHT_N_M
        if self.rests:
            return self.q
        direction = downhill / weight
        tool_m = float(np.linalg.norm((chain.jacobian(self.q) @ direction)[:3]))
        rate = min(_SLOWEST_RAD_S, self._speed_m_s / max(tool_m, 1e-6))
        self.q = np.clip(self.q + direction * rate * dt_s, chain.lower, chain.upper)
        return self.q
