"""Tactile servoing: hold a reference contact while moving along it (paper 3.3.2, figure 5 top)."""

from __future__ import annotations

import numpy as np

from touchcell.control.errors import ControlError
from touchcell.control.pid import Pid, PidGains
from touchcell.geometry import se3
from touchcell.geometry.types import Array


class TactileServo:
    """Map a contact pose to a twist of the tool.

    With ``T_s_f`` the surface frame in the sensor frame and ``T_s*_f`` the reference, the error motion is
    ``E = T_s_f inv(T_s*_f) = T_s_s*``: the desired sensor pose in the current sensor frame. Hence ``e = log(E)`` is the
    twist that takes the sensor there in one second, and positive gains close the loop. Pressed 1 mm less than the
    reference, ``e = [0 0 +0.001 0 0 0]``: the z axis points out of the tip, into the surface.

    The feedforward twist is given in the reference frame {s*} and mapped to {s} by ``Ad(E)``, so a tangential one
    stays tangential to the surface while the sensor is still tilted.

    A component whose gain rows are zero is not controlled. Its part of the reference is taken from the measurement
    (as extrinsic-xyz components of ``T_f_s``), so that a large uncontrolled shear does not leak into depth and tilt
    through the logarithm.

    Args:
        T_sref_f: reference contact (4, 4), surface frame in the desired sensor frame.
        T_tcp_sensor: pose (4, 4) of the sensor in the tool frame.
        gains: of the controller, on components [x y z alpha beta gamma] of the sensor's twist.
        period_s: time step assumed for the first estimate after a reset.
        decoupled: position and orientation have errors of their own, the translation of ``E`` and the logarithm of its
            rotation. Where ``E`` may turn far, as at a corner of an edge, the sensor then moves straight to its place
            while it turns, in place of along a screw.

    Raises:
        GeometryError: an argument is not a pose.
        ControlError: ``period_s`` is not positive.
    """

    def __init__(
        self, T_sref_f: Array, T_tcp_sensor: Array, gains: PidGains, period_s: float, *, decoupled: bool = False
    ) -> None:
        if not period_s > 0.0:
            raise ControlError("period_s", f"is {period_s}, not a positive time", period_s)
        self._T_f_sref = se3.inverse(T_sref_f)
        self._reference = se3.to_euler_mm_deg(self._T_f_sref)
        self._free = ~gains.controlled
        self._Ad_tcp_sensor = se3.adjoint(T_tcp_sensor)
        self._period_s = period_s
        self._decoupled = decoupled
        self._pid = Pid(gains)
        self.reset()

    def reset(self) -> None:
        """Clear the integral, the derivative and the held twist."""
        self._pid.reset()
        self._t_ns: int | None = None
        self._V_tcp = np.zeros(6)
        self._e = np.zeros(6)

    @property
    def active(self) -> bool:
        """True once a valid estimate has arrived since the latest reset."""
        return self._t_ns is not None

    @property
    def clipped(self) -> bool:
        """True if the controller's limits have cut the latest output."""
        return bool(self._pid.clipped.any())

    @property
    def latest_error(self) -> Array:
        """Error motion (6,) of the latest step on the controlled components, zero on the others and after a reset."""
        return np.where(self._free, 0.0, self._e)

    @property
    def reference_mm_deg(self) -> Array:
        """(6,) desired contact as Euler components of ``T_f_sref``; NaN for axes that are not controlled."""
        return np.where(self._free, np.nan, self._reference)

    def error(self, T_s_f: Array) -> Array:
        """Return the error motion ``e`` (6,), m and rad, in the sensor frame; see the class for its sign."""
        return self._error(self._error_pose(T_s_f))

    def step(self, T_s_f: Array | None, t_ns: int, V_ff: Array) -> Array:
        """Return the twist (6,) of the tool centre point along tool axes.

        The controller advances once for each new estimate and holds its output until the next one, so frames may arrive
        more slowly than control cycles without derivative kicks.

        Args:
            T_s_f: the estimate (4, 4); None while there is no valid one. Then the output is zero, feedforward included,
                and
                the state is reset.
            t_ns: time of the estimate.
            V_ff: feedforward twist (6,) in the reference frame {s*}.

        Raises:
            GeometryError, ControlError: an argument is not finite, of the wrong shape or not a pose.
        """
        if T_s_f is None:
            self.reset()
        elif self._t_ns is None or t_ns > self._t_ns:
            E = self._error_pose(T_s_f)
            dt_s = self._period_s if self._t_ns is None else (t_ns - self._t_ns) * 1e-9
            with np.errstate(invalid="ignore"):  # the controller raises on non-finite arguments, by name
                V_ff_s = (_turned(E) if self._decoupled else se3.adjoint(E)) @ V_ff
            e = self._error(E)
            V_s = self._pid.step(e, V_ff_s, dt_s)
            self._e = e
            self._V_tcp = self._Ad_tcp_sensor @ V_s
            self._t_ns = t_ns
        return self._V_tcp.copy()

    def _error(self, E: Array) -> Array:
        e = se3.log(E)
        if self._decoupled:
            e[:3] = E[:3, 3]
        return e

    def _error_pose(self, T_s_f: Array) -> Array:
        if not self._free.any():
            return se3.compose(T_s_f, self._T_f_sref)
        measured = se3.to_euler_mm_deg(se3.inverse(T_s_f))
        T_f_sref = se3.from_euler_mm_deg(np.where(self._free, measured, self._reference))
        return se3.compose(T_s_f, T_f_sref)


def _turned(E: Array) -> Array:
    """Return (6, 6): turns both halves of a twist without moving its origin."""
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = E[:3, :3]
    return turned
